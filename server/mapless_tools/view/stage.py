"""The drawn scene, the panel beside it, and the dialogue of a selected query."""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapless import Reference
from mapless.answers import Rejected
from mapless.geometry import Array
from mapless.names import reference_name
from mapless_tools.depth_points import ColouredPoints
from mapless_tools.draw.page import answer_page, best_references
from mapless_tools.matches import Picture, read_picture

from .clouds import Cloud
from .drawing import DOUBT, OTHER, QUERY, REFERENCE, SELECTED, Drawing, tinted
from .feed import THUMBNAIL_PX, Query
from .guarded import GuardedViser
from .scenery import Scenery

MAX_QUERIES = 12
"""Queries that are kept; each has its photograph in memory."""
REFERENCE_PX = 1200
"""Longer side of a reference's photograph in its dialogue, at most."""
_QUERY_SIZE = 1.5
"""Size of a query's frustum, relative to those of references."""
DEPTH_POINT_SHARE = 0.0025
"""Size of a point of a reference's depth, as a share of the scene's extent: smaller than matched ones."""
_FOUND, _LOST = (72, 84, 96), (178, 84, 36)
"""Colours of the buttons of queries."""
_NONE_YET = "None yet. They appear here as the server answers them."
_WIDE = "<style>.mantine-Modal-content { flex: 0 0 min(1000px, 94vw) !important; }</style>"
"""Style for dialogues as wide as photographs; viser's are narrow."""


@dataclass(eq=False)
class _Shown:
    """A query with its drawn shapes."""

    query: Query
    button: Any
    frustums: list[Any] = field(default_factory=list)
    support: list[Any] = field(default_factory=list)


class Stage:
    """The drawn scene; its methods may be called from any thread."""

    def __init__(self, server: GuardedViser, scenery: Scenery, title: str, open_photo: Callable[[str], bytes]) -> None:
        """Draws the references, at first without their photographs, which `open_photo` returns by their ids."""
        self._server, self._scenery, self._open_photo = server, scenery, open_photo
        self.drawing = Drawing(server, scenery)
        self._lock = threading.Lock()
        self._shown: deque[_Shown] = deque()
        self._selected: _Shown | None = None
        self._points = Cloud(self.drawing, "/points", scenery.extent_m)
        self._depth_points = Cloud(self.drawing, "/points-by-depth", scenery.extent_m)
        self._depths: list[Any] = []
        pictured = [(int(i), scenery.references[i]) for i in scenery.pictured]
        self._references = {it.reference_id: self._draw_reference(i, it) for i, it in pictured}
        self._dots = self._draw_others()
        self._panel(title)

    def report(self, status: str, is_watching: bool) -> None:
        """Shows the state of the watching, and whether queries will arrive."""
        with self._lock:
            self._status.content = f"Queries: **{status}**"
            self._nothing.content = _NONE_YET if is_watching else "None."

    def show_picture(self, reference_id: str, picture: Picture) -> None:
        """Shows a photograph on a reference's frustum."""
        self._references[reference_id].image = picture

    def show_points(self, points: Array, colours: NDArray[np.uint8], by_depth: NDArray[np.bool_]) -> None:
        """Adds matched points (N, 3) of the world with colours (N, 3), and whether a depth gives their distance."""
        placed = points - self._scenery.origin
        with self._lock:
            self._points.add(placed[~by_depth], colours[~by_depth], self._show_points.value)
            self._depth_points.add(placed[by_depth], tinted(colours[by_depth]), self._show_depths.value)

    def show_depth(self, reference_id: str, found: ColouredPoints) -> None:
        """Shows the depth of a reference."""
        placed, size_m = found.points - self._scenery.origin, DEPTH_POINT_SHARE * self._scenery.extent_m
        with self._lock:
            name = f"/depth/{len(self._depths)}-{reference_id}"
            visible = self._show_depths.value
            self._depths.append(self.drawing.points(name, placed, tinted(found.colours), size_m, visible))

    def show_query(self, query: Query) -> None:
        """Adds a query, and selects it."""
        with self._lock:
            colour = _FOUND if query.pose is not None else _LOST
            with self._list:
                button = self._server.gui.add_button(query.label, order=-query.number, color=colour)
            shown = _Shown(query, button)
            self._draw_query(shown)
            for handle in (button, *shown.frustums):
                handle.on_click(lambda event: self._open(shown, event.client))
            self._shown.append(shown)
            self._nothing.visible = False
            if len(self._shown) > MAX_QUERIES:
                gone = self._shown.popleft()
                for handle in (*gone.support, *gone.frustums, gone.button):
                    handle.remove()
        self._select(shown)

    def _select(self, shown: _Shown) -> None:
        with self._lock:
            self._selected = shown
            for it in self._shown:
                for handle in it.support:
                    handle.visible = it is shown and self._show_matches.value
                for handle in it.frustums:
                    handle.color = SELECTED if it is shown else DOUBT if it.query.pose is None else QUERY

    def _open(self, shown: _Shown, client: Any) -> None:
        """Selects a query, and shows the page of its answer."""
        self._select(shown)
        if client is None:  # it was closed meanwhile
            return
        query = shown.query
        with _dialogue(client, query.label) as gui:  # at once: drawing takes a second
            page = self._page(query)
            gui.add_html(
                f'<iframe sandbox srcdoc="{escape(page)}" style="width: 100%; height: 70vh; border: 0"></iframe>'
            )

    def _page(self, query: Query) -> str:
        known = {reference_name(it.scene_id, it.reference_id): it for it in self._scenery.references}
        used = {it.name for it in query.answer.diagnostics.references} & known.keys()
        pictured = best_references(query.answer)
        references = [
            replace(known[name], image=self._open_photo(known[name].reference_id)) if name in pictured else known[name]
            for name in used
        ]
        return answer_page(query.label, query.answer, query.image, query.camera, references, self._scenery.down)

    def _open_reference(self, reference: Reference, client: Any) -> None:
        if client is None:
            return
        picture = read_picture(self._open_photo(reference.reference_id), REFERENCE_PX)
        x, y, z = reference.world_from_camera.translation
        details = f"**Position** {x:.3f}, {y:.3f}, {z:.3f} m; {reference.feature_count} features"
        with _dialogue(client, f"Reference {reference.reference_id}") as gui:
            gui.add_image(picture, format="jpeg", jpeg_quality=88)
            gui.add_markdown(details)

    def _draw_reference(self, index: int, reference: Reference) -> Any:
        name, pose = f"/references/{index}", reference.world_from_camera
        handle = self.drawing.camera(name, reference.camera, pose, REFERENCE, 1.0)
        handle.on_click(lambda event: self._open_reference(reference, event.client))
        return handle

    def _draw_others(self) -> list[Any]:
        scenery = self._scenery
        others = np.setdiff1d(np.arange(len(scenery.references)), scenery.pictured)
        if not len(others):
            return []
        centres = np.stack([scenery.placed(scenery.references[i].world_from_camera).translation for i in others])
        colour = np.array(OTHER, np.uint8)
        return [self.drawing.points("/other-references", centres, colour, 0.15 * scenery.size_m, True)]

    def _draw_query(self, shown: _Shown) -> None:
        query, answer, name = shown.query, shown.query.answer, f"/queries/{shown.query.number}"
        picture = read_picture(query.image, 2 * THUMBNAIL_PX)
        if isinstance(answer, Rejected):
            poses = [it.world_from_camera for it in answer.hypotheses]
        else:
            poses = [answer.world_from_camera]
            shown.support = self.drawing.support(name, answer)
        size = _QUERY_SIZE * float(self._size.value)
        shown.frustums = [
            self.drawing.camera(f"{name}/camera-{i}", query.camera, pose, QUERY, size, picture)
            for i, pose in enumerate(poses)
        ]

    def _panel(self, title: str) -> None:
        gui = self._server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(36, 160, 120))
        gui.set_panel_label(f"mapless: {title}")
        hidden = len(self._scenery.references) - len(self._references)
        counted = f"{len(self._scenery.references)} references" + (f", {hidden} of them as dots" if hidden else "")
        gui.add_markdown(counted, order=0.1)
        self._status = gui.add_markdown("Queries: **connecting**", order=0.2)
        with gui.add_folder("Show", order=1):
            show_references = gui.add_checkbox("References", True)
            self._show_points = gui.add_checkbox("Points", True)
            self._show_depths = gui.add_checkbox("Points by depth", True)
            self._show_matches = gui.add_checkbox("Matches of the selected query", True)
            self._size = gui.add_slider("Size of cameras", 0.2, 3.0, 0.1, 1.0)
        with gui.add_folder("Queries", order=2) as self._list:
            self._nothing = gui.add_markdown(_NONE_YET)
        show_references.on_update(lambda _: self._show_references(show_references.value))
        for box in (self._show_points, self._show_depths):
            box.on_update(lambda _: self._show_clouds())
        self._show_matches.on_update(lambda _: self._select(self._selected) if self._selected else None)
        self._size.on_update(lambda _: self._resize())

    def _show_references(self, visible: bool) -> None:
        for handle in (*self._references.values(), *self._dots):
            handle.visible = visible

    def _show_clouds(self) -> None:
        with self._lock:
            self._points.show(self._show_points.value)
            self._depth_points.show(self._show_depths.value)
            for handle in self._depths:
                handle.visible = self._show_depths.value

    def _resize(self) -> None:
        size = float(self._size.value) * self._scenery.size_m
        for handle in self._references.values():
            handle.scale = size
        with self._lock:
            for it in self._shown:
                for handle in it.frustums:
                    handle.scale = _QUERY_SIZE * size


@contextmanager
def _dialogue(client: Any, title: str) -> Iterator[Any]:
    """A dialogue in the browser that requested it, to be filled in the block."""
    with client.gui.add_modal(title) as modal:
        client.gui.add_html(_WIDE)
        yield client.gui
        client.gui.add_button("Close").on_click(lambda _: modal.close())
