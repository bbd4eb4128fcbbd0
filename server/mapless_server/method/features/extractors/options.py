"""Options of the learned extractors."""

from dataclasses import dataclass

from mapless_server.bounds import check_bounds

from ..limits import MAX_KEYPOINTS, MAX_SIDE_PX, MULTIPLE_PX

ALIKED_VARIANT = "aliked-n16"
"""ALIKED's variant, in names of its features."""

WINDOW_PX = 5
"""Side of the window in which a keypoint is the strongest pixel."""


@dataclass(frozen=True)
class LearnedOptions:
    """Options of a learned extractor.

    Attributes:
        max_keypoints: the strongest are kept.
        max_side_px: longer images are reduced to it.
        min_score: weaker keypoints are dropped; the extractor's docstring gives the range of its scores.
    """

    max_keypoints: int = MAX_KEYPOINTS
    max_side_px: int = MAX_SIDE_PX
    min_score: float = 0.01

    def __post_init__(self) -> None:
        check_bounds(self, "max_keypoints", at_least=1)
        check_bounds(self, "max_side_px", at_least=MULTIPLE_PX)
        check_bounds(self, "min_score", at_least=0, below=1)

    def label(self, extractor: str, weights_sha256: str) -> str:
        """The name under which features are stored, e.g. "aliked-n16-2048-1024px-0.01-c2ab3d81"."""
        return f"{extractor}-{self.max_keypoints}-{self.max_side_px}px-{self.min_score:g}-{weights_sha256[:8]}"
