"""The viewer: a client of the server, the stage, and the work in the background that fills it."""

import hashlib
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np

from mapless import Client, ConnectOptions, MaplessError, Reference
from mapless import Scene as KnownScene
from mapless_server.errors import InvalidArgument
from mapless_tools.depth_points import depth_points, share_of
from mapless_tools.matches import colours_at, read_picture
from mapless_tools.report.asking import report_of_weeks

from .failures import Failures
from .feed import THUMBNAIL_PX, Feed, Query
from .guarded import GuardedViser
from .scenery import Scenery, lay_out
from .stage import Stage

log = logging.getLogger(__name__)

_FIRST = 40
"""Photographs that are loaded before the first points."""
SEED_NEIGHBOURS = 8
"""References that one is localized against to show points."""


@contextmanager
def viewer(
    address: str, connect: ConnectOptions, scene: str, *, host: str, port: int, max_pictured: int, seeds: int
) -> Iterator[str]:
    """Shows a scene until the block ends; yields the page's address. Errors as in `lay_out` and `GuardedViser`.

    It is shown on a loopback address, since there is no authentication, and a port, 0 for any. `max_pictured`
    references are drawn with their photographs, spread over the scene: more make browsers slow. So many `seeds` are
    localized against their neighbours for the first points; half a second of the server's computing each.
    """
    with ExitStack() as stack:
        client = stack.enter_context(Client(address, connect))
        known = client.get_scene(scene)
        scenery = lay_out(known, list(client.list_references(scene)), max_pictured)

        def open_photo(reference_id: str) -> bytes:
            return client.get_reference(scene, reference_id, include_image=True).image or b""

        server = GuardedViser(host, port, f"mapless: {scene}")
        stack.callback(server.stop)
        stage = Stage(server, scenery, scene, open_photo)
        Failures(server, stage.drawing, scenery, partial(report_of_weeks, client, scene))
        work = _Background(client, known, scenery, stage)
        stack.callback(work.close)
        feed = Feed(address, connect, scene, work.show_query, stage.report)
        stack.callback(feed.close)
        work.begin(feed, seeds)
        yield f"http://{host}:{server.get_port()}"


class _Background:
    """Fills the stage after it is shown: photographs on frustums, points, and live queries."""

    def __init__(self, client: Client, scene: KnownScene, scenery: Scenery, stage: Stage) -> None:
        self._client, self._scene, self._scenery, self._stage = client, scene.scene_id, scenery, stage
        self._is_metric = not scene.arbitrary_unit
        # One call at a time: the server has other clients.
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="view")
        self._closing = threading.Event()

    def begin(self, feed: Feed, seeds: int) -> None:
        """Loads the first photographs, then points, then the other photographs, of which there may be many."""
        loads = [partial(self._load, self._scenery.references[index]) for index in self._scenery.pictured]
        points = [partial(self._seed, feed, int(index)) for index in self._scenery.pictured[:seeds]]
        for work in (*loads[:_FIRST], *points, *loads[_FIRST:]):
            self._pool.submit(self._do, work)

    def close(self) -> None:
        self._closing.set()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def show_query(self, query: Query) -> None:
        try:
            self._stage.show_query(query)
            self._show_points(query)
        except InvalidArgument as error:
            log.warning("query %d cannot be shown: %s", query.number, error)

    def _do(self, work: Callable[[], None]) -> None:
        """Runs `work`, unless the viewer closes; a failure is logged only."""
        try:
            if not self._closing.is_set():
                work()
        except (MaplessError, InvalidArgument) as error:
            if not self._closing.is_set():
                log.warning("%s", error)

    def _load(self, reference: Reference) -> None:
        stored = self._client.get_reference(self._scene, reference.reference_id, include_image=True)
        picture = read_picture(stored.image or b"", 4 * THUMBNAIL_PX)
        small = read_picture(stored.image or b"", THUMBNAIL_PX)
        self._stage.show_picture(reference.reference_id, small)
        found = depth_points(stored, picture, share_of(len(self._scenery.pictured)), self._is_metric)
        if found is not None:
            self._stage.show_depth(reference.reference_id, found)

    def _seed(self, feed: Feed, index: int) -> None:
        """Localizes a reference against its neighbours, for their common points."""
        reference = self._scenery.references[index]
        near = [it.reference_id for it in self._scenery.neighbours(index, SEED_NEIGHBOURS)]
        if len(near) < 2:
            return
        image = self._client.get_reference(self._scene, reference.reference_id, include_image=True).image or b""
        feed.own.add(hashlib.sha256(image).digest())
        answer = self._client.localize(image, reference.camera, self._scene, near, include_debug=True)
        self._show_points(Query(0, image, reference.camera, answer))

    def _show_points(self, query: Query) -> None:
        debug = query.answer.debug
        if query.pose is None or debug is None or not debug.is_inlier.any():
            return
        picture = read_picture(query.image, 4 * THUMBNAIL_PX)
        good = np.flatnonzero(debug.is_inlier)
        colours = colours_at(picture, query.camera, debug.query_px[good])
        self._stage.show_points(debug.x_in_world[good], colours, debug.is_by_depth[good])
