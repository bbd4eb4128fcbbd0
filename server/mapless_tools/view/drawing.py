"""Drawing on viser's scene: cameras, points, the ellipsoid of a covariance and lines of matches, placed and scaled."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mapless.answers import LocalizationResult
from mapless.geometry import Array, Camera, RigidTransform
from mapless_tools.matches import GOOD, SOURCE_COLOURS, WRONG, Picture

from .scenery import Scenery

if TYPE_CHECKING:
    from .guarded import GuardedViser

CHI2_95_IN_SPACE = 7.8147279
"""Square of how many standard deviations an ellipsoid of 95 % reaches in three dimensions."""
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def ellipsoid(covariance: Array, steps: int = 18) -> tuple[Array, NDArray[np.uint32]]:
    """Vertices (V, 3) around the origin and faces (F, 3) of the ellipsoid that contains 95 % of positions.

    The covariance is (3, 3) or more, of which the first three are the position, square metres. There are half as many
    parallels as meridians.
    """
    values, axes = np.linalg.eigh(covariance[:3, :3])
    radii = np.sqrt(np.maximum(values, 0.0) * CHI2_95_IN_SPACE)
    rows = steps // 2 + 1
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, steps + 1), indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    vertices = (unit.reshape(-1, 3) * radii) @ axes.T
    corner = (np.arange(rows - 1)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    right, below, across = corner + 1, corner + steps + 1, corner + steps + 2
    faces = np.concatenate([np.stack([corner, below, right], axis=1), np.stack([right, below, across], axis=1)])
    if np.linalg.det(axes) < 0:  # a mirrored sphere is seen from within
        faces = faces[:, ::-1]
    return vertices, faces.astype(np.uint32)


def enlargement(covariance: Array, size_m: float) -> int:
    """Factor by which an ellipsoid is drawn larger, so that it is visible beside something of this size."""
    largest = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0) * CHI2_95_IN_SPACE))
    if largest <= 0:
        return 1
    return max((factor for factor in _FACTORS if factor * largest <= size_m), default=1)


def rays(centre: Array, points: Array, count: int, longest_m: float) -> Array:
    """Lines (N, 2, 3) from a camera's centre to points (M, 3): at most `count`, evenly thinned, and none too long."""
    chosen = points
    if len(points) > count:
        chosen = points[np.linspace(0, len(points) - 1, count).round().astype(int)]
    length = np.linalg.norm(chosen - centre, axis=1, keepdims=True)
    end = centre + (chosen - centre) * np.minimum(1.0, longest_m / np.maximum(length, 1e-9))
    return np.stack([np.broadcast_to(centre, end.shape), end], axis=1)


Colour = tuple[int, int, int]

REFERENCE, OTHER, QUERY, SELECTED, DOUBT = (
    (96, 122, 168),
    (120, 128, 140),
    (46, 200, 150),
    (255, 190, 60),
    (230, 90, 40),
)
"""Colours of references, of those drawn as dots, of queries, of the selected one, and of poses that contradict each
other."""
TINT = 0.35
"""Share of the tint in the colour of a point by depth."""
MAX_RAYS = 90
"""Lines from a query to its points; more hide what they lead to."""


def rgb(colour: str) -> Colour:
    """Red, green and blue, 0 to 255, of a colour such as "#2f7bd0"."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


BY_DEPTH = rgb(SOURCE_COLOURS["MEASURED_DEPTH"][1])
"""Colour of lines to points by depth, and tint of these."""


def tinted(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours (N, 3) of points by depth, between their own and that of points by depth."""
    return np.asarray((1 - TINT) * colours + TINT * np.array(BY_DEPTH), np.uint8)


class Drawing:
    """Draws shapes; returns viser's handles, to change or remove them."""

    def __init__(self, server: "GuardedViser", scenery: Scenery) -> None:
        self._scene, self._scenery = server.scene, scenery
        self._set_the_view(server)

    def camera(
        self,
        name: str,
        camera: Camera,
        world_from_camera: RigidTransform,
        colour: Colour,
        size: float,
        picture: Picture | None = None,
    ) -> Any:
        """Draws a frustum with its photograph, `size` times as large as the scenery's."""
        pose = self._scenery.placed(world_from_camera)
        q = pose.quaternion()
        return self._scene.add_camera_frustum(
            name,
            fov=float(2 * np.arctan2(camera.height_px / 2, camera.focal_y_px)),
            aspect=(camera.width_px / camera.focal_x_px) / (camera.height_px / camera.focal_y_px),
            scale=size * self._scenery.size_m,
            thickness=1.6 if colour == REFERENCE else 2.6,
            thickness_units="screen",
            color=colour,
            image=picture,
            format="jpeg",
            wxyz=(q.w, q.x, q.y, q.z),
            position=tuple(pose.translation.tolist()),
            cast_shadow=False,
            receive_shadow=False,
        )

    def points(self, name: str, placed: Array, colours: NDArray[np.uint8], size_m: float, visible: bool) -> Any:
        """Draws points (N, 3), already in the scenery's place, with one colour or one each."""
        return self._scene.add_point_cloud(
            name,
            placed,
            colours,
            point_size=size_m,
            point_shape="circle",
            point_shading="flat",
            precision="float32",
            visible=visible,
        )

    def arrow(self, name: str, label: str, position: Array, forward: Array, size: float) -> list[Any]:
        """Draws an arrow from a position (3,), world, along a unit vector, with a label at its beginning.

        It is `size` times as long as the scenery's cameras.
        """
        length = size * self._scenery.size_m
        start = position - self._scenery.origin
        ends = np.stack([start, start + length * forward])[None]
        shown = self._scene.add_arrows(
            name,
            ends,
            SELECTED,
            shaft_radius=0.03 * length,
            head_radius=0.09 * length,
            head_length=0.25 * length,
        )
        return [shown, self._scene.add_label(f"{name}-label", label, position=tuple(start.tolist()))]

    def support(self, name: str, answer: LocalizationResult) -> list[Any]:
        """Draws a pose's 95 % ellipsoid, and lines to the matched points."""
        return self._ellipsoid(name, answer) + self._rays(name, answer)

    def _ellipsoid(self, name: str, answer: LocalizationResult) -> list[Any]:
        covariance, centre = answer.covariance, self._scenery.placed(answer.world_from_camera).translation
        if covariance is None or not np.isfinite(covariance).all():
            return []
        factor = enlargement(covariance, 0.6 * self._scenery.size_m)
        vertices, faces = ellipsoid(covariance)
        position = tuple(centre.tolist())
        mesh = self._scene.add_mesh_simple(
            f"{name}/ellipsoid",
            factor * vertices,
            faces,
            color=SELECTED,
            opacity=0.45,
            side="double",
            position=position,
            cast_shadow=False,
        )
        if factor == 1:
            return [mesh]
        return [mesh, self._scene.add_label(f"{name}/label", f"95 %, {factor} times as large", position=position)]

    def _rays(self, name: str, answer: LocalizationResult) -> list[Any]:
        if answer.debug is None:
            return []
        centre, longest_m = self._scenery.placed(answer.world_from_camera).translation, 1.5 * self._scenery.extent_m
        points, right = answer.debug.x_in_world - self._scenery.origin, answer.debug.is_inlier
        by_depth, drawn = answer.debug.is_by_depth, []
        for kind, rows, colour, count in (
            ("right", right & ~by_depth, rgb(GOOD), MAX_RAYS),
            ("right-by-depth", right & by_depth, BY_DEPTH, MAX_RAYS),
            ("wrong", ~right, rgb(WRONG), MAX_RAYS // 4),
        ):
            lines = rays(centre, points[rows], count, longest_m)
            if len(lines):
                shown = self._scene.add_line_segments(
                    f"{name}/{kind}", lines, colour, thickness=1.2, thickness_units="screen"
                )
                drawn.append(shown)
        return drawn

    def _set_the_view(self, server: "GuardedViser") -> None:
        scenery = self._scenery
        up = -scenery.down
        server.scene.set_up_direction(tuple(up.tolist()))
        ahead = np.mean([it.world_from_camera.rotation[:, 2] for it in scenery.references], axis=0)
        ahead = ahead - (ahead @ up) * up
        if np.linalg.norm(ahead) < 0.2:  # they look all around
            ahead = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
        ahead = ahead / np.linalg.norm(ahead)
        reach = max(scenery.extent_m, 4 * scenery.size_m)
        server.initial_camera.position = tuple((-0.5 * reach * ahead + 0.45 * reach * up).tolist())
        server.initial_camera.look_at = tuple((0.4 * reach * ahead).tolist())
