"""Intrinsics that are read otherwise than they were meant, each with its correction.

Some leave a mark: a principal point at the first pixel is that of a K given by columns, a focal length of a pixel that
of a K that was never set. What was meant is then unknown, and the image's centre and a focal length that fits stand in.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from mapless.geometry import Camera, RigidTransform

from ...features.views import PosedView, undistort_pixels
from .conventions import RARE, USUAL, Mistake

LEAST_FOCAL_SHARE = 0.1
"""Share of the image's longer side; a shorter focal length would be a pinhole with more than 157 degrees of view."""
SAME_SHARE = 0.01
"""Share of the image's longer side; coordinates that differ by less cannot be distinguished."""


def with_camera(posed: PosedView, camera: Camera) -> PosedView:
    """A view with another pinhole; keypoints are undistorted anew where the lens is known."""
    view = posed.view
    if view.distortion is None:
        return replace(posed, view=replace(view, camera=camera))
    seen = replace(view.camera, distortion=view.distortion).project(view.camera.rays(view.features.keypoints))
    ideal = undistort_pixels(seen, replace(camera, distortion=view.distortion))
    features = replace(view.features, keypoints=ideal.astype(np.float32))
    return replace(posed, view=replace(view, camera=camera, features=features))


def centred(camera: Camera) -> Camera:
    """The camera with its principal point in the image's centre."""
    return replace(camera, principal_x_px=(camera.width_px - 1) / 2, principal_y_px=(camera.height_px - 1) / 2)


def usual_camera(camera: Camera) -> Camera:
    """A camera with square pixels, a centred principal point, and the longer side as its focal length: 53 degrees."""
    focal_px = float(max(camera.width_px, camera.height_px))
    return replace(centred(camera), focal_x_px=focal_px, focal_y_px=focal_px)


def is_at_first_pixel(camera: Camera) -> bool:
    """Whether the principal point is that of a K that was given by columns, or not set."""
    bound_px = SAME_SHARE * max(camera.width_px, camera.height_px)
    return max(abs(camera.principal_x_px), abs(camera.principal_y_px)) <= bound_px


def is_unset(camera: Camera) -> bool:
    """Whether the focal length is none of a camera: of a K that was not set, or not in pixels."""
    return min(camera.focal_x_px, camera.focal_y_px) < LEAST_FOCAL_SHARE * max(camera.width_px, camera.height_px)


def camera_mistakes(views: Sequence[PosedView]) -> Iterator[Mistake[PosedView]]:
    """The mistakes that these views, one at least, may have; none whose correction would change next to nothing."""
    cameras = [view.view.camera for view in views]
    if all(map(is_at_first_pixel, cameras)):
        if not any(map(is_unset, cameras)):
            text = (
                "K is given by columns, or its last column is missing: the principal point (cx, cy) is 0 0, and one in "
                "the image's centre fits"
            )
            yield _mistake(text, centred)
    elif _differ(cameras, lambda it: it.principal_x_px - it.principal_y_px):
        yield _mistake(
            "cx and cy are exchanged",
            lambda it: replace(it, principal_x_px=it.principal_y_px, principal_y_px=it.principal_x_px),
        )
    if _differ(cameras, lambda it: it.focal_x_px - it.focal_y_px):
        yield _mistake(
            "fx and fy are exchanged", lambda it: replace(it, focal_x_px=it.focal_y_px, focal_y_px=it.focal_x_px)
        )
    for quarters in (1, 2, 3):
        text = f"poses and intrinsics are of images turned by {90 * quarters} degrees (EXIF orientation)"
        yield Mistake(text, turned(quarters), RARE)


def _mistake(text: str, change: Callable[[Camera], Camera]) -> Mistake[PosedView]:
    return Mistake(text, lambda view: with_camera(view, change(view.view.camera)), USUAL)


def _differ(cameras: Sequence[Camera], difference_px: Callable[[Camera], float]) -> bool:
    """Whether two numbers of the cameras differ by a share of the images' longer sides that can be distinguished."""
    return bool(np.median([abs(difference_px(it)) / max(it.width_px, it.height_px) for it in cameras]) > SAME_SHARE)


_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""A quarter turn about the optical axis."""


def turned(quarters: int) -> Callable[[PosedView], PosedView]:
    """Correction of a photograph that was turned so often to the left, without its pose and its intrinsics."""

    def correct(view: PosedView) -> PosedView:
        camera = view.view.camera
        fx, fy, x, y = camera.focal_x_px, camera.focal_y_px, camera.principal_x_px, camera.principal_y_px
        sides_px = [camera.width_px, camera.height_px]
        for remaining in range(quarters, 0, -1):
            fx, fy, x, y = fy, fx, y, sides_px[remaining % 2] - 1 - x
        camera = replace(camera, focal_x_px=fx, focal_y_px=fy, principal_x_px=x, principal_y_px=y)
        rotation = view.world_from_camera.rotation @ np.linalg.matrix_power(_QUARTER, quarters)
        pose = RigidTransform(rotation, view.world_from_camera.translation)
        return replace(view, view=replace(view.view, camera=camera), world_from_camera=pose)

    return correct


def focal_scaled(view: PosedView, scale: float) -> PosedView:
    """A view with its focal lengths multiplied."""
    camera = view.view.camera
    camera = replace(camera, focal_x_px=scale * camera.focal_x_px, focal_y_px=scale * camera.focal_y_px)
    return replace(view, view=replace(view.view, camera=camera))


def scaled(view: PosedView, scale: float) -> PosedView:
    """A view with its focal lengths and its principal point multiplied."""
    camera = focal_scaled(view, scale).view.camera
    camera = replace(camera, principal_x_px=scale * camera.principal_x_px, principal_y_px=scale * camera.principal_y_px)
    return replace(view, view=replace(view.view, camera=camera))
