"""The options of reading videos and photographs; they check themselves."""

from dataclasses import dataclass, field
from pathlib import Path

from mapless_server.images import ImageLimits

MAX_FRAMES = 10_000


@dataclass(frozen=True)
class SourceOptions:
    """How many frames all videos give together, the images that are accepted, and folders that are not read.

    Mapping takes longer than in proportion to the photographs; 150 of them show a flat or a floor. The folder of the
    output is to be among `excluded`, since it may lie within a source.
    """

    frames: int = 150
    limits: ImageLimits = field(default_factory=ImageLimits)
    excluded: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if not 2 <= self.frames <= MAX_FRAMES:
            raise ValueError(f"frames must be 2 to {MAX_FRAMES}, is {self.frames}")
