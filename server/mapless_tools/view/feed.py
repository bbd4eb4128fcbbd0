"""Queries, and receiving them as they are answered, by WatchQueries; connects again when needed."""

import hashlib
import itertools
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass

import grpc

from mapless import ConnectOptions, MaplessError, wire
from mapless.addresses import addresses_of
from mapless.answers import LocalizationResult, Rejected
from mapless.errors import from_rpc_error
from mapless.geometry import Camera, RigidTransform
from mapless.messages import answer_from_message
from mapless.names import scene_name
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless.wire import FieldError


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


def _length(metres: float) -> str:
    return (
        f"{metres:.2f} m" if metres >= 1 else f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.1f} mm"
    )


THUMBNAIL_PX = 160


log = logging.getLogger(__name__)

RETRY_S = 3.0
"""Between two tries to watch: servers end a connection now and then, so that it moves on to another."""
_HOPELESS = ("FAILED_PRECONDITION", "PERMISSION_DENIED", "UNAUTHENTICATED", "UNIMPLEMENTED", "NOT_FOUND")
"""Errors that another try does not change."""


class Feed:
    """Watches a scene in a thread of its own, until it is closed."""

    def __init__(
        self,
        address: str,
        options: ConnectOptions,
        scene: str,
        show: Callable[[Query], None],
        report: Callable[[str, bool], None],
    ) -> None:
        """Watches a scene: `show` is called with queries, `report` with the state and whether queries will come."""
        self._channels = [options.channel(it) for it in addresses_of(address)]
        self._stubs = itertools.cycle(map(LocalizationServiceStub, self._channels))
        self._metadata = options.metadata()
        self._request = pb.WatchQueriesRequest(scene=scene_name(scene))
        self._show, self._report = show, report
        self.own: set[bytes] = set()
        """SHA-256 of photographs that the viewer localizes itself; the next query of each is not shown."""
        self._count = 0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="feed", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the watching."""
        self._closing.set()
        for channel in self._channels:
            channel.close()
        self._thread.join(5.0)

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                self._watch()
            except grpc.RpcError as error:
                failure = from_rpc_error(error)
                if self._closing.is_set():
                    return
                self._report(_words(failure), failure.code not in _HOPELESS)
                if failure.code in _HOPELESS:
                    return
            except FieldError as error:
                log.warning("an answer of the server breaks its contract: %s", error)
            except ValueError:  # the channel was closed meanwhile
                return
            self._closing.wait(RETRY_S)

    def _watch(self) -> None:
        call = next(self._stubs).WatchQueries(self._request, metadata=self._metadata)
        call.initial_metadata()
        if call.is_active():
            self._report("live", True)
        for message in call:
            digest = hashlib.sha256(message.image).digest()
            if digest in self.own:  # another client may localize the same photograph later
                self.own.remove(digest)
                continue
            self._count += 1 + message.missed_count
            if not (message.image and message.intrinsics.width_px):  # too large, or of a camera that nothing shows
                continue
            camera = wire.camera_from_message(message.intrinsics, "intrinsics")
            self._show(Query(self._count, message.image, camera, answer_from_message(message.answer)))


def _words(failure: MaplessError) -> str:
    if failure.reason == "WATCHING_NOT_ALLOWED":
        return "not shown: the server's setting allow_watching is off"
    if failure.code == "PERMISSION_DENIED":
        return "not shown: that takes a token of the role write"
    if failure.code in _HOPELESS:
        return f"not shown: {failure.message}"
    return "waiting for the server"
