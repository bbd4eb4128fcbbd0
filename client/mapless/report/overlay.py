"""The photograph with its matches: inliers with residuals, and outliers."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mapless.diagnostics import Debug, ReferenceUse
from mapless.geometry import Array, Camera, RigidTransform
from mapless.results import Reference

from .markup import number, reference_id, text
from .pictures import Picture

PHOTO_ID = "photograph"
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200)
_SEEN_SHARE = 0.006
"""Drawn length of a median residual, relative to the photograph's width."""
_LONGEST_SHARE = 0.06
"""Longest line of an outlier to its projected point, relative to the photograph's width."""


def define(picture: Picture, camera: Camera) -> str:
    """The photograph, stored once for all drawings."""
    image = image_of(picture, camera, f'id="{PHOTO_ID}"')
    return f'<svg class="store" aria-hidden="true"><defs>{image}</defs></svg>'


def image_of(picture: Picture, camera: Camera, attributes: str = "") -> str:
    """Draws a picture scaled to its camera's pixels, or an empty frame; (0, 0) is the centre of the first pixel."""
    place = f'x="-0.5" y="-0.5" width="{camera.width_px}" height="{camera.height_px}"'
    if not picture.uri:
        return f'<rect {attributes} {place} class="empty"/>'
    return f'<image {attributes} {place} preserveAspectRatio="none" href="{picture.uri}"/>'


def overlay(debug: Debug, camera: Camera, world_from_camera: RigidTransform | None) -> str:
    """Draws the figure; without a pose, it has no residuals."""
    dot = camera.width_px / 1000
    inlier = debug.is_inlier
    layers = []
    if world_from_camera is not None:
        projected = camera.project(world_from_camera.inverse().apply(debug.x_in_world))
        residual = projected - debug.query_px
        factor = magnification(residual[inlier], camera.width_px)
        layers += [
            _layer("outlier far", _lines(debug.query_px[~inlier], _shortened(residual[~inlier], camera)), 1.2 * dot),
            _layer("inlier residual", _lines(debug.query_px[inlier], factor * residual[inlier]), 1.6 * dot),
        ]
        longer = f", drawn {factor} times as long" if factor > 1 else ""
        residuals = f"Lines: from a matched pixel to the projection of its point{longer}."
    else:
        residuals = "The pose of the inliers was rejected." if inlier.any() else ""
    layers += [
        _layer("outlier", _crosses(debug.query_px[~inlier], 3.2 * dot), 1.5 * dot),
        _layer("inlier halo", _dots(debug.query_px[inlier]), 6.4 * dot),
        _layer("inlier", _dots(debug.query_px[inlier]), 4.6 * dot),
    ]
    switches = _switch("outlier", f"{len(inlier)} matches, none verified")
    if inlier.any():
        switches = _switch("inlier", f"{inlier.sum()} agree with the pose")
        switches += _switch("outlier", f"{(~inlier).sum()} do not")
    view = f"-0.5 -0.5 {camera.width_px} {camera.height_px}"
    return (
        '<figure class="overlay">'
        f"{switches}"
        f'<svg viewBox="{view}" role="img" aria-label="The photograph and its matches">'
        f'<use href="#{PHOTO_ID}"/>{"".join(layers)}</svg>'
        f"<figcaption>{text(residuals)}</figcaption></figure>"
    )


def magnification(residual: Array, width_px: int) -> int:
    """Factor by which residuals (N, 2) are drawn longer, so that a median one is visible."""
    lengths = np.linalg.norm(residual, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        return 1
    wanted = _SEEN_SHARE * width_px / max(float(np.median(lengths)), 1e-6)
    return max((it for it in _MAGNIFICATIONS if it <= wanted), default=1)


def _switch(layer: str, label: str) -> str:
    box = f'<input type="checkbox" id="show-{layer}" checked>'
    return f'{box}<label for="show-{layer}" class="{layer}">{text(label)}</label>'


def _layer(kind: str, path: str, width: float) -> str:
    return f'<path class="{kind}" d="{path}" stroke-width="{number(width)}"/>' if path else ""


def _dots(pixels: Array) -> str:
    """Lines of length 0, whose round ends are dots: one element for all of them."""
    return "".join(f"M{number(x)} {number(y)}h0" for x, y in pixels.tolist())


def _crosses(pixels: Array, size: float) -> str:
    d = number(2 * size)
    return "".join(f"M{number(x - size)} {number(y - size)}l{d} {d}m0 -{d}l-{d} {d}" for x, y in pixels.tolist())


def _lines(start: Array, step: Array) -> str:
    both = np.concatenate([start, step], axis=1)[np.isfinite(step).all(axis=1)]
    return "".join(f"M{number(x)} {number(y)}l{number(dx)} {number(dy)}" for x, y, dx, dy in both.tolist())


def _shortened(step: NDArray[np.float64], camera: Camera) -> Array:
    """Vectors (N, 2), shortened to the longest that does not cover the photograph."""
    longest = _LONGEST_SHARE * camera.width_px
    lengths = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, longest / np.maximum(lengths, 1e-9)))


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
    debug: Debug, uses: Sequence[ReferenceUse], camera: Camera, reference: Reference, name: str, picture: Picture
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
