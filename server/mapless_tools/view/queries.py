"""Queries and photographs as the viewer shows them: small ones on frustums, and a query's with its matches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.answers import LocalizationResult, Rejected
from mapless.geometry import Array, Camera, RigidTransform, resized_pixel
from mapless_server.images import ImageLimits, decode_image


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph, its camera, and the answer; numbered in order of arrival."""

    number: int
    image: bytes
    camera: Camera
    answer: LocalizationResult | Rejected

    @property
    def pose(self) -> RigidTransform | None:
        """The answered pose; None for a rejection."""
        return self.answer.world_from_camera if isinstance(self.answer, LocalizationResult) else None

    @property
    def label(self) -> str:
        """One line for a list."""
        if isinstance(self.answer, Rejected):
            return f"#{self.number} not localized: {self.answer.reason.lower().replace('_', ' ')}"
        radius = self.answer.accuracy
        return f"#{self.number} localized" + (f" to {_length(radius.position_95_m)}" if radius is not None else "")

    def details(self) -> str:
        """All details as Markdown; text from other sources is in code spans, so that it is not interpreted."""
        answer, used = self.answer, self.answer.diagnostics
        lines = []
        if isinstance(answer, Rejected):
            lines.append(f"**Not localized**: {_code(answer.message)}")
            if answer.hint is not None:
                lines.append(f"**What helps:** {_code(answer.hint.message)}")
        else:
            if answer.accuracy is not None:
                by = answer.accuracy.calibrated_by
                of = f"calibrated {by}" if by else "not calibrated in this scene"
                radii = f"{_length(answer.accuracy.position_95_m)} and {answer.accuracy.rotation_95_deg:.2f}°"
                lines.append(f"**95 % within** {radii} ({of})")
            if answer.trust is not None:
                lines.append(f"**Trust** {answer.trust:.2f}")
            lines.append(f"**Matches** {answer.inlier_count} of {answer.match_count} agree with the pose")
            x, y, z = answer.world_from_camera.translation
            lines.append(f"**Position** {x:.3f}, {y:.3f}, {z:.3f} m")
            if answer.arbitrary_unit:
                lines.append("**Unit** arbitrary: lengths are not in metres")
            lines += [
                f"**Prior contradicts:** {_code(it.kind.lower())}, at Mahalanobis distance {it.mahalanobis:.1f}"
                for it in answer.prior_checks
                if it.conflict
            ]
        best = sorted(used.references, key=lambda it: -it.inlier_count)[:4]
        if best:
            named = ", ".join(f"{_code(it.name.rpartition('/')[2])} {it.inlier_count}" for it in best)
            lines.append(f"**Inliers by reference** {named}")
        lines.append(f"**Time** {1000 * used.total_s:.0f} ms, request {_code(used.request_id)}")
        return "\n\n".join(lines)


def _code(text: str) -> str:
    """Text in a code span, which is not read as Markdown."""
    shown = " ".join(text.replace("`", "'").split())
    return f"`{shown}`" if shown else ""


def _length(metres: float) -> str:
    return (
        f"{metres:.2f} m" if metres >= 1 else f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.1f} mm"
    )


THUMBNAIL_PX = 160
OVERLAY_PX = 1200
INLIER, OUTLIER, RESIDUAL = (46, 230, 166), (255, 107, 43), (255, 225, 77)
"""Red, green and blue of what agrees with the pose, of what does not, and of how far it is off."""
_LIMITS = ImageLimits(max_bytes=1 << 30, max_pixels=200_000_000)
"""The server has checked the photograph; its limits may be higher than its defaults."""

Picture = NDArray[np.uint8]


def read_picture(image: bytes, max_side_px: int) -> Picture:
    """Reads a photograph (H, W, 3) RGB and limits its longer side; InvalidArgument if it cannot be read."""
    pixels = decode_image(image, _LIMITS)
    scale = max_side_px / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def colours_at(picture: Picture, camera: Camera, pixels: Array) -> NDArray[np.uint8]:
    """Colours (N, 3) of a reduced photograph at pixels (N, 2) of the whole one."""
    height, width = picture.shape[:2]
    at = _reduced(pixels, camera, picture).round().astype(int)
    return np.asarray(picture[np.clip(at[:, 1], 0, height - 1), np.clip(at[:, 0], 0, width - 1)], np.uint8)


def overlay(query: Query) -> Picture:
    """The photograph with its matches: the matched pixels, and lines to the points' projections."""
    picture = _enlarged(read_picture(query.image, OVERLAY_PX))
    debug = query.answer.debug
    if debug is None:
        return picture
    seen = _reduced(debug.query_px, query.camera, picture)
    if query.pose is not None:
        placed = _projected(query.camera, query.pose, debug.x_in_world)
        _lines(picture, seen, _reduced(placed, query.camera, picture), debug.is_inlier)
    size = max(2, round(picture.shape[1] / 350))
    for is_good, colour in ((False, OUTLIER), (True, INLIER)):
        for x, y in seen[debug.is_inlier == is_good]:
            centre = round(float(x)), round(float(y))
            cv2.circle(picture, centre, size + 1, (12, 20, 24), -1, cv2.LINE_AA)
            cv2.circle(picture, centre, size, colour, -1, cv2.LINE_AA)
    return picture


def _enlarged(picture: Picture) -> Picture:
    """Enlarges a small photograph, so that the drawing does not hide it."""
    factor = OVERLAY_PX // max(picture.shape[:2])
    if factor < 2:
        return picture
    return np.asarray(cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8)


def _projected(camera: Camera, world_from_camera: RigidTransform, x_in_world: Array) -> Array:
    return camera.project(world_from_camera.inverse().apply(x_in_world))


def _lines(picture: Picture, seen: Array, placed: Array, is_inlier: NDArray[np.bool_]) -> None:
    """Draws the lines, wrong matches first, and none longer than a tenth of the picture, so that they hide nothing."""
    step = placed - seen
    length = np.linalg.norm(step, axis=1, keepdims=True)
    end = seen + step * np.minimum(1.0, 0.1 * picture.shape[1] / np.maximum(length, 1e-9))
    for is_good, colour in ((False, OUTLIER), (True, RESIDUAL)):
        for i in np.flatnonzero((is_inlier == is_good) & np.isfinite(end).all(axis=1)):
            (x, y), (u, v) = seen[i], end[i]
            cv2.line(picture, (round(x), round(y)), (round(u), round(v)), colour, 1, cv2.LINE_AA)


def _reduced(pixels: Array, camera: Camera, picture: Picture) -> Array:
    """Pixels (N, 2) of the whole photograph in the reduced one."""
    scale_x, scale_y = picture.shape[1] / camera.width_px, picture.shape[0] / camera.height_px
    return np.stack([resized_pixel(pixels[:, 0], scale_x), resized_pixel(pixels[:, 1], scale_y)], axis=-1)
