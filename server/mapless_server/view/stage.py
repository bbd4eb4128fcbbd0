"""What is drawn, by viser: frustums, points, and the queries as they come; and the panel beside it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapless import Reference
from mapless.answers import LocalizationResult, Rejected
from mapless.geometry import Array, Camera, RigidTransform

from .guarded import GuardedViser
from .meshes import ellipsoid, enlargement, rays
from .pictures import INLIER, OUTLIER, THUMBNAIL_PX, Picture, overlay, read_picture
from .queries import Query
from .scenery import Scenery

MAX_QUERIES = 12
"""Queries that stay to be looked at; each keeps its photograph in memory."""
MAX_POINTS = 150_000
MAX_RAYS = 150
"""Lines from a query to its points; more hide what they lead to."""
_REFERENCE, _OTHER, _QUERY, _SELECTED, _DOUBT = (
    (96, 122, 168),
    (120, 128, 140),
    (46, 200, 150),
    (255, 190, 60),
    (230, 90, 40),
)
_QUERY_SIZE = 1.5
"""Of a query's frustum beside those of references."""
_VOXEL_SHARE = 0.002
"""Of the scene's extent: points nearer than this to one another are shown as one."""


@dataclass(eq=False)
class _Shown:
    """A query and what of it is on the stage."""

    query: Query
    button: Any
    frustums: list[Any] = field(default_factory=list)
    others: list[Any] = field(default_factory=list)


class Stage:
    """The drawn scene; its methods may be called from any thread."""

    def __init__(self, server: GuardedViser, scenery: Scenery, title: str, open_photo: Callable[[str], bytes]) -> None:
        """Draws the references, still without their photographs.

        Args:
            server: where it is drawn.
            scenery: the references.
            title: the scene's id.
            open_photo: the photograph of a reference of an id.
        """
        self._server, self._scenery, self._open_photo = server, scenery, open_photo
        self._lock = threading.Lock()
        self._shown: deque[_Shown] = deque()
        self._selected: _Shown | None = None
        self._points: dict[bytes, tuple[Array, NDArray[np.uint8]]] = {}
        self._cloud: Any = None
        self._frustums: dict[str, Any] = {}
        self._panel(title)
        self._set_the_view()
        self._draw_references()

    def say(self, status: str) -> None:
        """How the watching goes."""
        self._status.content = f"Queries: **{status}**"

    def show_picture(self, reference_id: str, picture: Picture) -> None:
        """Puts a photograph onto a reference's frustum."""
        self._frustums[reference_id].image = picture

    def show_points(self, points: Array, colours: NDArray[np.uint8]) -> None:
        """Adds points (N, 3) of the world with colours (N, 3) to those that are shown."""
        placed = points - self._scenery.origin
        cells = np.round(placed / (_VOXEL_SHARE * self._scenery.extent_m)).astype(np.int64)
        with self._lock:
            before = len(self._points)
            for cell, point, colour in zip(cells, placed, colours, strict=True):
                if len(self._points) < MAX_POINTS:
                    self._points.setdefault(cell.tobytes(), (point, colour))
            if len(self._points) == before:
                return
            shown = list(self._points.values())
        self._cloud = self._server.scene.add_point_cloud(
            "/points",
            np.stack([point for point, _ in shown]),
            np.stack([colour for _, colour in shown]),
            point_size=self._point_size(),
            point_shape="circle",
            point_shading="flat",
            precision="float32",
            visible=self._show_points.value,
        )

    def show_query(self, query: Query) -> None:
        """Adds a query, and selects it where none was chosen by hand."""
        with self._lock:
            with self._list:
                button = self._server.gui.add_button(query.label, order=-query.number)
            shown = _Shown(query, button)
            button.on_click(lambda event: self._open(shown, event.client))
            self._draw_query(shown)
            self._shown.append(shown)
            self._nothing.visible = False
            if len(self._shown) > MAX_QUERIES:
                self._remove(self._shown.popleft())
        self.select(shown)

    def select(self, shown: _Shown) -> None:
        """Draws the lines of one query, and of no other."""
        with self._lock:
            for it in self._shown:
                for handle in it.others:
                    handle.visible = it is shown and self._show_matches.value
                for handle in it.frustums:
                    handle.color = _SELECTED if it is shown else _DOUBT if it.query.pose is None else _QUERY
            self._selected = shown

    def _open(self, shown: _Shown, client: Any) -> None:
        """Selects a query, and shows its photograph with its matches."""
        self.select(shown)
        if client is None:
            return
        with client.gui.add_modal(shown.query.label) as modal:
            client.gui.add_image(overlay(shown.query), format="jpeg", jpeg_quality=88)
            if shown.query.answer.debug is not None:
                client.gui.add_markdown(
                    "Green agrees with the pose, orange does not; lines lead to where it puts the points."
                )
            client.gui.add_markdown(shown.query.details())
            client.gui.add_button("Close").on_click(lambda _: modal.close())

    def _panel(self, title: str) -> None:
        gui = self._server.gui
        gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="medium", brand_color=(36, 160, 120)
        )
        gui.set_panel_label(f"mapless: {title}")
        counted = f"{len(self._scenery.references)} references"
        hidden = len(self._scenery.references) - len(self._scenery.pictured)
        gui.add_markdown(counted + (f", {hidden} of them as dots" if hidden else ""), order=0.1)
        self._status = gui.add_markdown("Queries: **connecting**", order=0.2)
        with gui.add_folder("Show", order=1):
            show_references = gui.add_checkbox("References", True)
            self._show_points = gui.add_checkbox("Points", True)
            self._show_matches = gui.add_checkbox("Matches of the selected query", True)
            self._size = gui.add_slider("Size of cameras", 0.2, 3.0, 0.1, 1.0)
        with gui.add_folder("Queries", order=2) as self._list:
            self._nothing = gui.add_markdown("None yet. They appear here as the server answers them.")

        @show_references.on_update
        def _(_: Any) -> None:
            for handle in (*self._frustums.values(), *self._dots):
                handle.visible = show_references.value

        @self._show_points.on_update
        def _(_: Any) -> None:
            if self._cloud is not None:
                self._cloud.visible = self._show_points.value

        @self._show_matches.on_update
        def _(_: Any) -> None:
            if self._selected is not None:
                self.select(self._selected)

        @self._size.on_update
        def _(_: Any) -> None:
            for handle in self._frustums.values():
                handle.scale = self._frustum_scale(1.0)
            for it in self._shown:
                for handle in it.frustums:
                    handle.scale = self._frustum_scale(_QUERY_SIZE)

    def _set_the_view(self) -> None:
        """From behind and above the references, looking where they look."""
        scenery, server = self._scenery, self._server
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

    def _draw_references(self) -> None:
        scenery = self._scenery
        for index in scenery.pictured:
            reference = scenery.references[index]
            handle = self._frustum(
                f"/references/{index}", reference.camera, reference.world_from_camera, _REFERENCE, 1.0
            )
            handle.on_click(lambda event, it=reference: self._open_reference(it, event.client))
            self._frustums[reference.reference_id] = handle
        others = np.setdiff1d(np.arange(len(scenery.references)), scenery.pictured)
        self._dots = []
        if len(others):
            centres = np.stack([scenery.references[i].world_from_camera.translation for i in others]) - scenery.origin
            self._dots.append(
                self._server.scene.add_point_cloud(
                    "/other-references",
                    centres,
                    np.array(_OTHER, np.uint8),
                    point_size=0.15 * scenery.size_m,
                    point_shape="circle",
                    precision="float32",
                )
            )

    def _open_reference(self, reference: Reference, client: Any) -> None:
        if client is None:
            return
        picture = read_picture(self._open_photo(reference.reference_id), 1000)
        with client.gui.add_modal(f"Reference {reference.reference_id}") as modal:
            client.gui.add_image(picture, format="jpeg")
            x, y, z = reference.world_from_camera.translation
            client.gui.add_markdown(f"**Position** {x:.3f}, {y:.3f}, {z:.3f} m; {reference.feature_count} features")
            client.gui.add_button("Close").on_click(lambda _: modal.close())

    def _draw_query(self, shown: _Shown) -> None:
        query, answer, name = shown.query, shown.query.answer, f"/queries/{shown.query.number}"
        picture = read_picture(query.image, 2 * THUMBNAIL_PX)
        if isinstance(answer, Rejected):
            for i, it in enumerate(answer.hypotheses):
                shown.frustums.append(
                    self._frustum(f"{name}/{i}", query.camera, it.world_from_camera, _DOUBT, _QUERY_SIZE, picture)
                )
        else:
            shown.frustums.append(
                self._frustum(f"{name}/camera", query.camera, answer.world_from_camera, _QUERY, _QUERY_SIZE, picture)
            )
            self._draw_support(shown, answer, name)
        for handle in shown.frustums:
            handle.on_click(lambda event: self._open(shown, event.client))

    def _draw_support(self, shown: _Shown, answer: LocalizationResult, name: str) -> None:
        """The ellipsoid, and lines to the matched points."""
        scene, pose = self._server.scene, self._scenery.placed(answer.world_from_camera)
        if answer.covariance is not None and np.isfinite(answer.covariance).all():
            factor = enlargement(answer.covariance, 0.6 * self._scenery.size_m)
            vertices, faces = ellipsoid(answer.covariance)
            shown.others.append(
                scene.add_mesh_simple(
                    f"{name}/ellipsoid",
                    factor * vertices,
                    faces,
                    color=_SELECTED,
                    opacity=0.45,
                    side="double",
                    position=tuple(pose.translation.tolist()),
                    cast_shadow=False,
                )
            )
            if factor > 1:
                shown.others.append(
                    scene.add_label(f"{name}/label", f"95 %, {factor} times as large", position=pose.translation)
                )
        if answer.debug is None:
            return
        points = answer.debug.x_in_world - self._scenery.origin
        for kind, rows, colour in (
            ("right", answer.debug.is_inlier, INLIER),
            ("wrong", ~answer.debug.is_inlier, OUTLIER),
        ):
            lines = rays(pose.translation, points[rows], MAX_RAYS if kind == "right" else MAX_RAYS // 5)
            if len(lines):
                shown.others.append(
                    scene.add_line_segments(f"{name}/{kind}", lines, colour, thickness=1.2, thickness_units="screen")
                )

    def _frustum(
        self,
        name: str,
        camera: Camera,
        world_from_camera: RigidTransform,
        colour: tuple[int, int, int],
        size: float,
        picture: Picture | None = None,
    ) -> Any:
        pose = self._scenery.placed(world_from_camera)
        q = pose.quaternion()
        return self._server.scene.add_camera_frustum(
            name,
            fov=float(2 * np.arctan2(camera.height_px / 2, camera.focal_y_px)),
            aspect=(camera.width_px / camera.focal_x_px) / (camera.height_px / camera.focal_y_px),
            scale=self._frustum_scale(size),
            thickness=1.6 if size == 1 else 2.6,
            thickness_units="screen",
            color=colour,
            image=picture,
            format="jpeg",
            wxyz=(q.w, q.x, q.y, q.z),
            position=tuple(pose.translation.tolist()),
            cast_shadow=False,
            receive_shadow=False,
        )

    def _frustum_scale(self, size: float) -> float:
        return size * self._scenery.size_m * float(self._size.value)

    def _point_size(self) -> float:
        return 0.004 * self._scenery.extent_m

    def _remove(self, shown: _Shown) -> None:
        for handle in (*shown.others, *shown.frustums, shown.button):
            handle.remove()
