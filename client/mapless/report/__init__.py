"""One answer as one HTML file that can be mailed: what was seen, where it is, how far it may be off, or why not.

The file needs nothing else: no scripts, nothing from elsewhere, the photographs are in it. Ask for the answer's debug
part, else there is nothing to draw.
"""

from __future__ import annotations

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
    """Writes the report of one answer, less than 5 MB; gives its path.

    Args:
        answer: what `localize` answered; with `debug`, its matches are drawn.
        image: the photograph as it was sent, or a smaller copy of it.
        camera: as it was sent.
        path: where to; an existing file is replaced.
        references: of the scene, for the plan view; the best of those with images are shown beside the photograph.
        title: what to call the photograph; its name, and the scene's.
        down_in_world: which way is down in the scene; guessed from the cameras if None.

    Raises:
        OSError: the file cannot be written, or the photograph not be read.
    """
    page = report_html(answer, read_image(image), camera, references, title, down_in_world)
    file = Path(path)
    file.write_text(page, encoding="utf-8")
    return file
