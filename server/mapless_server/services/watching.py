"""Publishes answered queries to the watchers of their scene: from Localize to WatchQueries.

Everything runs on the event loop. Photographs are in memory until they are sent, and are not stored: at most
MAX_WATCHERS times QUEUE_LENGTH, so 24 images of `max_image_mib` (384 MiB by default), and the message being sent to
each watcher. A watcher that reads nothing for a minute is disconnected (see `rpc.sending`); the message that was
being sent to it stays in memory until it is read or the connection ends. Without watchers the cost is one look-up in a
dictionary.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

from mapless.v1 import geometry_pb2 as geometry_pb
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import TRYING
from mapless_server.errors import FailedPrecondition, Overloaded, Unavailable
from mapless_server.security import SceneKey, tenant_of

MAX_WATCHERS = 8
"""Largest number for all scenes together: each may have `QUEUE_LENGTH` photographs in memory."""
MAX_WATCHERS_OF_TENANT = 4
"""So that one tenant cannot use up the limit of all."""
QUEUE_LENGTH = 3
"""Answers that wait for a watcher; a slow reader misses the oldest."""


_Watched = tuple[bytes, geometry_pb.CameraIntrinsics, pb.LocalizeResponse]
"""A photograph as it was sent, its camera, and the answer with its matches."""

Check = Callable[[], Awaitable[None]]
"""Raises the error with which a watcher ends."""


class Watcher:
    """The messages to one watcher of a scene, an asynchronous iterator; ends with Unavailable when the server stops."""

    def __init__(
        self, unregister: "Callable[[Watcher], None]", max_message_bytes: int, check: Check | None = None
    ) -> None:
        """Calls `unregister` when closed; messages above the limit are sent without their photograph.

        Before each message `check` is awaited, and its error ends the iterator.
        """
        self._unregister = unregister
        self._max_message_bytes = max_message_bytes
        self._check = check
        self._waiting: deque[_Watched] = deque(maxlen=QUEUE_LENGTH)
        self._missed_count = 0
        self._has_ended = False
        self._changed = asyncio.Event()

    def put(self, watched: _Watched) -> None:
        """Adds an answer; drops the oldest one if too many wait."""
        if len(self._waiting) == QUEUE_LENGTH:
            self._missed_count += 1
        self._waiting.append(watched)
        self._changed.set()

    def end(self) -> None:
        """Ends the iterator, after the server has begun to stop."""
        self._has_ended = True
        self._changed.set()

    def __aiter__(self) -> "Watcher":
        return self

    async def __anext__(self) -> pb.WatchQueriesResponse:
        """Returns the oldest waiting answer, with the number of answers that were dropped before it."""
        while not (self._waiting or self._has_ended):
            self._changed.clear()
            await self._changed.wait()
        if self._has_ended:
            raise Unavailable("the server is stopping", reason="DRAINING", retry_after_s=1.0)
        if self._check is not None:
            await self._check()
        image, intrinsics, answer = self._waiting.popleft()
        missed, self._missed_count = self._missed_count, 0
        message = pb.WatchQueriesResponse(image=image, intrinsics=intrinsics, answer=answer, missed_count=missed)
        if message.ByteSize() > self._max_message_bytes:  # a photograph nearly as large as a message may be
            message.ClearField("image")
        return message

    async def aclose(self) -> None:
        """Ends the iterator on behalf of the watcher."""
        self._unregister(self)


class Watchers:
    """The watchers of all scenes; only scenes that are watched are in `by_scene`."""

    def __init__(self, are_allowed: bool, max_message_bytes: int = 32 * 2**20) -> None:
        """Makes the object without watchers; `are_allowed` is the setting `allow_watching`."""
        self._are_allowed = are_allowed
        self._max_message_bytes = max_message_bytes
        self.by_scene: dict[SceneKey, set[Watcher]] = {}

    def publish(
        self,
        scene_key: SceneKey | None,
        request: pb.LocalizeRequest,
        response: pb.LocalizeResponse,
        debug: pb.Debug | None,
    ) -> None:
        """Sends a copy of an answer to the watchers of its scene; no matches if the computation ended before.

        Nothing in it is of another scene that the photograph was compared with: they may not read that one.
        """
        if scene_key not in self.by_scene:
            return
        answer = pb.LocalizeResponse()
        answer.CopyFrom(response)
        _remove_other_scenes(answer)
        if debug is not None:
            answer.debug.CopyFrom(debug)
        # A copy, since a field of a message keeps the whole message in memory, with its image.
        used = response.rejection if response.HasField("rejection") else response.localization
        intrinsics, given = geometry_pb.CameraIntrinsics(), request.HasField("intrinsics")
        intrinsics.CopyFrom(request.intrinsics if given else used.used_intrinsics.intrinsics)
        watched = request.image, intrinsics, answer
        for watcher in self.by_scene[scene_key]:
            watcher.put(watched)

    def check(self, tenant: str) -> None:
        """Checks whether a tenant may have another watcher.

        FailedPrecondition if the server is not configured to allow it; Overloaded if there are too many watchers.
        """
        if not self._are_allowed:
            raise FailedPrecondition(
                "the server does not show callers' photographs; its setting allow_watching lets it",
                reason="WATCHING_NOT_ALLOWED",
            )
        counts = {key: len(watchers) for key, watchers in self.by_scene.items()}
        of_tenant = sum(count for key, count in counts.items() if tenant_of(key) == tenant)
        if sum(counts.values()) >= MAX_WATCHERS or of_tenant >= MAX_WATCHERS_OF_TENANT:
            raise Overloaded("there are too many watchers", reason="TOO_MANY_WATCHERS", retry_after_s=5.0)

    def watch(self, scene_key: SceneKey, check: Check | None = None) -> Watcher:
        """Makes a watcher of the scene's answers from now on, until it is closed; `check` as of `Watcher`.

        FailedPrecondition or Overloaded, see `check`.
        """
        self.check(tenant_of(scene_key))
        watcher = Watcher(lambda it: self._unregister(scene_key, it), self._max_message_bytes, check)
        self.by_scene.setdefault(scene_key, set()).add(watcher)
        return watcher

    def close(self) -> None:
        """Ends all watchers, when the server stops."""
        for watchers in self.by_scene.values():
            for watcher in watchers:
                watcher.end()

    def _unregister(self, scene_key: SceneKey, watcher: Watcher) -> None:
        watchers = self.by_scene[scene_key]
        watchers.remove(watcher)
        if not watchers:
            del self.by_scene[scene_key]


def _remove_other_scenes(answer: pb.LocalizeResponse) -> None:
    """Removes what an answer among several scenes says of others than its own, and that there are others.

    Which scene an attempt, a cut or the time of a stage was of is not known here, so none is left.
    """
    diagnostics, rejection = answer.diagnostics, answer.rejection
    if diagnostics.searched_scene_count <= 1:
        return
    for name in ("scenes", "attempts", "ladder_cuts", "stages"):
        diagnostics.ClearField(name)
    diagnostics.searched_scene_count = 1
    if rejection.HasField("hint"):  # which may say what was not tried
        rejection.hint.message = rejection.hint.message.partition(f" {TRYING}")[0]
    its = [it for it in rejection.hypotheses if it.scene == answer.scene]
    if len(its) < len(rejection.hypotheses):
        del rejection.hypotheses[:]
        rejection.hypotheses.extend(its)
        rejection.message = "several poses explain the photograph"
