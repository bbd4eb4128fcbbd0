"""Who watches a scene's queries as they are answered: a hub between Localize and WatchQueries.

Everything runs on the event loop. Photographs are held in memory until they are sent, a few for each watcher, and
stored nowhere: at most MAX_WATCHERS times QUEUE_LENGTH, so 24 images of `max_image_mib` (384 MiB by default), and the
message that each watcher is being sent. One that reads nothing for a minute is sent away (see `sending`); what it was
being sent is held until it reads it or its connection ends. Without watchers it costs a look into a dictionary.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from mapless.v1 import geometry_pb2 as geometry_pb
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.errors import FailedPrecondition, Overloaded, Unavailable
from mapless_server.security.tenancy import SceneKey, tenant_of

MAX_WATCHERS = 8
"""Of all scenes together: each may hold `QUEUE_LENGTH` photographs in memory."""
MAX_WATCHERS_OF_TENANT = 4
"""So that one tenant cannot keep the others from watching."""
QUEUE_LENGTH = 3
"""Answers that wait for a watcher; one that reads more slowly than they come misses the oldest."""


@dataclass(frozen=True, eq=False)
class Watched:
    """A query that was answered: its photograph as it was sent, its camera, and the answer with what it rests on."""

    image: bytes
    intrinsics: geometry_pb.CameraIntrinsics
    answer: pb.LocalizeResponse


class Watch:
    """What somebody who watches a scene gets to see: messages, for as long as they are asked for.

    It ends with Unavailable, when the server stops.
    """

    def __init__(self, forget: Callable[[Watch], None], max_message_bytes: int) -> None:
        """`forget` is told when it ends; messages larger than the limit go without their photograph."""
        self._forget = forget
        self._max_message_bytes = max_message_bytes
        self._waiting: deque[Watched] = deque(maxlen=QUEUE_LENGTH)
        self._missed_count = 0
        self._is_over = False
        self._news = asyncio.Event()

    def tell(self, watched: Watched) -> None:
        """Something to see."""
        if len(self._waiting) == QUEUE_LENGTH:
            self._missed_count += 1
        self._waiting.append(watched)
        self._news.set()

    def end(self) -> None:
        """There will be nothing more."""
        self._is_over = True
        self._news.set()

    def __aiter__(self) -> Watch:
        return self

    async def __anext__(self) -> pb.WatchQueriesResponse:
        """The oldest that was not seen, and how many were missed before it."""
        while not (self._waiting or self._is_over):
            self._news.clear()
            await self._news.wait()
        if self._is_over:
            raise Unavailable("the server is stopping", reason="DRAINING", retry_after_s=1.0)
        watched = self._waiting.popleft()
        missed, self._missed_count = self._missed_count, 0
        message = pb.WatchQueriesResponse(
            image=watched.image, intrinsics=watched.intrinsics, answer=watched.answer, missed_count=missed
        )
        if message.ByteSize() > self._max_message_bytes:  # a photograph nearly as large as a message may be
            message.ClearField("image")
        return message

    async def aclose(self) -> None:
        """Nobody looks any more."""
        self._forget(self)


class Watchers:
    """Passes answers on to those who watch their scene."""

    def __init__(self, are_allowed: bool, max_message_bytes: int = 32 * 2**20) -> None:
        """Nobody watches yet.

        Args:
            are_allowed: the setting: whether callers' photographs may be shown to others at all.
            max_message_bytes: the largest message that can be sent.
        """
        self._are_allowed = are_allowed
        self._max_message_bytes = max_message_bytes
        self._of_scene: dict[SceneKey, set[Watch]] = {}

    def is_watched(self, scene_key: SceneKey) -> bool:
        """Whether somebody watches the scene: then its answers are wanted with what they rest on."""
        return scene_key in self._of_scene

    def publish(
        self, scene_key: SceneKey, request: pb.LocalizeRequest, response: pb.LocalizeResponse, debug: pb.Debug | None
    ) -> None:
        """Shows an answer to those who watch its scene.

        Args:
            scene_key: which scene.
            request: with the photograph.
            response: as its caller gets it; it is not changed, and not kept.
            debug: what the answer rests on; None where the computation did not come so far.
        """
        watches = self._of_scene.get(scene_key)
        if watches is None:
            return
        answer = pb.LocalizeResponse()
        answer.CopyFrom(response)
        if debug is not None:
            answer.debug.CopyFrom(debug)
        # A part of a message keeps all of it, with the image a second time.
        intrinsics = geometry_pb.CameraIntrinsics()
        intrinsics.CopyFrom(request.intrinsics)
        watched = Watched(request.image, intrinsics, answer)
        for watch in watches:
            watch.tell(watched)

    def check(self, tenant: str) -> None:
        """Whether somebody may begin to watch.

        Raises:
            FailedPrecondition: the server is not configured to allow it.
            Overloaded: too many watch already.
        """
        if not self._are_allowed:
            raise FailedPrecondition(
                "the server does not show callers' photographs; its setting allow_watching lets it",
                reason="WATCHING_NOT_ALLOWED",
            )
        counts = {key: len(watches) for key, watches in self._of_scene.items()}
        of_tenant = sum(count for key, count in counts.items() if tenant_of(key) == tenant)
        if sum(counts.values()) >= MAX_WATCHERS or of_tenant >= MAX_WATCHERS_OF_TENANT:
            raise Overloaded("too many watch already", reason="TOO_MANY_WATCHERS", retry_after_s=5.0)

    def watch(self, scene_key: SceneKey) -> Watch:
        """The scene's answers from now on, until it is closed.

        Raises:
            FailedPrecondition, Overloaded: see `check`.
        """
        self.check(tenant_of(scene_key))
        watch = Watch(lambda it: self._forget(scene_key, it), self._max_message_bytes)
        self._of_scene.setdefault(scene_key, set()).add(watch)
        return watch

    def close(self) -> None:
        """Sends everybody away, since the server stops."""
        for watches in self._of_scene.values():
            for watch in watches:
                watch.end()

    def _forget(self, scene_key: SceneKey, watch: Watch) -> None:
        watches = self._of_scene[scene_key]
        watches.remove(watch)
        if not watches:
            del self._of_scene[scene_key]
