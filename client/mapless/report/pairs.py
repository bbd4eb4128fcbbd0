"""The photograph beside its best references, with lines between matched points."""

from collections.abc import Mapping, Sequence

import numpy as np

from ..answers import Debug, ReferenceUse
from ..geometry import Array, Camera
from ..results import Reference
from .markup import number, reference_id, text
from .overlay import PHOTO_ID, image_of
from .pictures import Picture

MAX_PAIRS = 3
_HEIGHT = 480.0
_GAP = 16.0
_MAX_LINES, _MAX_WRONG = 140, 30
"""More lines hide one another."""


def best_references(debug: Debug | None, uses: Sequence[ReferenceUse]) -> list[str]:
    """Names of the best references, by inliers, then by matches."""
    order = sorted(uses, key=lambda use: (-use.inlier_count, -use.match_count))
    shown = order if debug is None else [use for use in order if (_rows(debug, uses, use.name)).any()]
    return [use.name for use in shown[:MAX_PAIRS]]


def pair(
    debug: Debug,
    uses: Sequence[ReferenceUse],
    camera: Camera,
    reference: Reference,
    name: str,
    picture: Picture,
) -> str:
    """Draws one figure; empty without matches."""
    rows = _rows(debug, uses, name)
    if not rows.any():
        return ""
    left, right = _HEIGHT / camera.height_px, _HEIGHT / reference.camera.height_px
    offset = left * camera.width_px + _GAP
    width = offset + right * reference.camera.width_px
    start = left * (debug.query_px + 0.5)
    end = right * (debug.reference_px + 0.5) + (offset, 0.0)
    # Without a pose, no match is verified.
    inlier = debug.is_inlier if debug.is_inlier.any() else np.ones(len(debug.is_inlier), bool)
    good, wrong = _some(rows & inlier, start, _MAX_LINES), _some(rows & ~inlier, start, _MAX_WRONG)
    hue = np.argsort(np.argsort(start[good, 0])) * (300 / max(len(good), 1))
    lines = [_line(start[i], end[i], 'class="outlier"') for i in wrong]
    for i, h in zip(good, hue, strict=True):
        lines.append(_line(start[i], end[i], f'style="stroke:hsl({h:.0f} 85% 60%)"'))
    use = next(use for use in uses if use.name == name)
    caption = (
        f"<b>{text(reference_id(name))}</b>: {use.inlier_count} inliers on points that it shows, {use.match_count} "
        f"feature matches. Drawn: {len(good)} of {(rows & inlier).sum()} matches that it shows best"
        + (f", and {len(wrong)} that do not agree with the pose." if len(wrong) else ".")
    )
    shown = picture.note and f" {text(picture.note)}"
    return (
        f'<figure class="pair"><svg viewBox="0 0 {number(width)} {number(_HEIGHT)}" role="img" '
        f'aria-label="Matches with {text(reference_id(name))}">'
        f'<g transform="scale({left:.6f}) translate(.5 .5)"><use href="#{PHOTO_ID}"/></g>'
        f'<g transform="translate({number(offset)} 0) scale({right:.6f}) translate(.5 .5)">'
        f"{image_of(picture, reference.camera)}</g>"
        f'<g class="lines">{"".join(lines)}</g></svg><figcaption>{caption}{shown}</figcaption></figure>'
    )


def pairs(
    debug: Debug | None,
    uses: Sequence[ReferenceUse],
    camera: Camera,
    references: Mapping[str, Reference],
    pictures: Mapping[str, Picture],
) -> str:
    """The figures of the best references that are given."""
    if debug is None:
        return ""
    known = [name for name in best_references(debug, uses) if name in references]
    return "".join(pair(debug, uses, camera, references[name], name, pictures.get(name, Picture())) for name in known)


def _rows(debug: Debug, uses: Sequence[ReferenceUse], name: str) -> np.ndarray:
    index = next((i for i, use in enumerate(uses) if use.name == name), -1)
    return np.asarray(debug.reference == index)


def _some(rows: np.ndarray, start: Array, count: int) -> np.ndarray:
    """Selects the rows to draw: all, or `count` of them evenly from left to right."""
    found = np.flatnonzero(rows)
    found = found[np.argsort(start[found, 0], kind="stable")]
    if len(found) <= count:
        return found
    return np.asarray(found[np.linspace(0, len(found) - 1, count).round().astype(int)])


def _line(start: Array, end: Array, look: str) -> str:
    (x, y), (u, v) = start.tolist(), end.tolist()
    return (
        f'<path {look} d="M{number(x)} {number(y)}L{number(u)} {number(v)}"/>'
        f'<circle {look} cx="{number(x)}" cy="{number(y)}" r="2.6"/>'
        f'<circle {look} cx="{number(u)}" cy="{number(v)}" r="2.6"/>'
    )
