"""The photograph with its matches: inliers with residuals, and outliers."""

import math

import numpy as np
from numpy.typing import NDArray

from ..answers import Debug
from ..geometry import Array, Camera, RigidTransform
from .markup import number, text
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


def histogram(debug: Debug) -> str:
    """Histogram of the errors of inliers and outliers, up to twice the 95 % quantile of inliers."""
    known = np.isfinite(debug.error_px)
    if not (known & debug.is_inlier).any():
        return ""
    limit = max(1, math.ceil(2 * float(np.quantile(debug.error_px[known & debug.is_inlier], 0.95))))
    edges = np.linspace(0.0, limit, 33)
    counts = [np.histogram(debug.error_px[known & part], edges)[0] for part in (debug.is_inlier, ~debug.is_inlier)]
    highest = max(int((counts[0] + counts[1]).max()), 1)
    bars = []
    for i, (good, bad) in enumerate(zip(*counts, strict=True)):
        x, below, above = 10 * i, 90 * good / highest, 90 * bad / highest
        bars.append(f'<rect class="inlier" x="{x}" y="{number(100 - below)}" width="9" height="{number(below)}"/>')
        top = number(100 - below - above)
        bars.append(f'<rect class="outlier" x="{x}" y="{top}" width="9" height="{number(above)}"/>')
    ticks = "".join(
        f'<text x="{number(320 * share)}" y="114" text-anchor="{anchor}">{limit * share:g}</text>'
        for share, anchor in ((0, "start"), (0.5, "middle"), (1, "end"))
    )
    beyond = int((debug.error_px[known] > limit).sum() + (~known).sum())
    more = f" {beyond} are larger or undefined." if beyond else ""
    return (
        '<figure class="histogram"><svg viewBox="0 0 320 118" role="img" aria-label="Histogram of the errors">'
        f'{"".join(bars)}<path class="axis" d="M0 100H320"/>{ticks}</svg>'
        f"<figcaption>Reprojection errors, pixels of the processed photograph.{more}</figcaption></figure>"
    )


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
