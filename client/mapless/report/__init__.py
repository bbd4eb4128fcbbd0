"""An answer as one HTML file: matches, pose and accuracy, or the reason of a rejection. Begin with `write_report`.

The file is self-contained: no scripts, no links, the photographs are in it. Matches are drawn only if the answer was
requested with `include_debug`.
"""

from collections.abc import Sequence
from pathlib import Path

from numpy.typing import ArrayLike

from ..answers import LocalizationResult, Rejected
from ..geometry import Camera
from ..requests import ImageSource, read_image
from ..results import Reference
from .page import report_html

__all__ = ["report_html", "write_report"]


def write_report(
    answer: LocalizationResult | Rejected,
    image: ImageSource,
    camera: Camera,
    path: str | Path,
    *,
    references: Sequence[Reference] = (),
    title: str = "",
    down_in_world: ArrayLike | None = None,
) -> Path:
    """Writes the report of one answer, less than 5 MB; returns its path.

    Args:
        answer: the answer of `localize`; with `debug`, its matches are drawn.
        image: the photograph as it was sent, or a smaller copy of it.
        camera: as it was sent.
        path: the file; an existing one is replaced.
        references: references of the scene, for the plan view; the best of those with images are shown beside the
            photograph.
        title: for example the names of photograph and scene.
        down_in_world: direction of gravity in the scene; None to estimate it from the cameras.

    Raises:
        OSError: the file cannot be written, or the photograph cannot be read.
    """
    page = report_html(answer, read_image(image), camera, references, title, down_in_world)
    file = Path(path)
    file.write_text(page, encoding="utf-8")
    return file
