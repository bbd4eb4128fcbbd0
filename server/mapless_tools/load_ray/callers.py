"""Callers that go on calling while replicas come and go: how every call ended, and which stored references are lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from mapless import Client, ConnectOptions, MaplessError, NewReference, RigidTransform
from mapless.geometry import Camera
from mapless_tools.load.no_op import CAMERA, padded_photo

END_LIMIT_S = 60.0


@dataclass(frozen=True)
class Call:
    """A call that has ended; times of `time.monotonic`.

    Attributes:
        caller: its caller's number.
        begin_s: before its first attempt.
        end_s: after its last one.
        error: its final error; empty if it was answered.
    """

    caller: int
    begin_s: float
    end_s: float
    error: str = ""


@dataclass
class Calls:
    """All calls that were made.

    Attributes:
        ended: in the order of their ends.
        acknowledged: (scene, reference) of all that the server reported as stored.
    """

    ended: list[Call] = field(default_factory=list)
    acknowledged: list[tuple[str, str]] = field(default_factory=list)

    @property
    def failed(self) -> list[Call]:
        """Those that failed in spite of the client's retries."""
        return [call for call in self.ended if call.error]

    def between(self, begin_s: float, end_s: float) -> Calls:
        """Those that were in progress at some time between."""
        return Calls([call for call in self.ended if call.end_s >= begin_s and call.begin_s <= end_s])

    @property
    def slowest_s(self) -> float:
        """The longest duration of a call with its retries; 0 if there was none."""
        return max((call.end_s - call.begin_s for call in self.ended), default=0.0)

    @property
    def longest_gap_s(self) -> float:
        """The longest time that one caller was without an answer."""
        last: dict[int, float] = {}
        longest_s = 0.0
        for call in self.ended:
            if not call.error:
                longest_s = max(longest_s, call.end_s - last.get(call.caller, call.end_s))
                last[call.caller] = call.end_s
        return longest_s


Kind = Callable[[Client, int, Calls], None]
"""Makes one call; its arguments are the client, the number of the call and all calls so far."""


@contextmanager
def calling(
    address: str, kinds: Sequence[Kind], pause_s: float = 0.0, options: ConnectOptions | None = None
) -> Iterator[Calls]:
    """A caller for each kind of call, each with a connection of its own, until the block is left.

    Args:
        address: "host:port".
        kinds: of calls.
        pause_s: between a caller's calls.
        options: of the connections; None for the client's defaults, with retries.
    """
    calls, done, lock = Calls(), threading.Event(), threading.Lock()

    def call_on(caller: int, kind: Kind) -> None:
        with Client(address, replace(options or ConnectOptions(), client_id=f"caller-{caller}")) as client:
            number = 0
            while not done.is_set():
                begin_s, error = time.monotonic(), ""
                try:
                    kind(client, number, calls)
                except MaplessError as failure:
                    error = f"call {caller}-{number}, {time.monotonic() - begin_s:.2f} s: {failure.code}: {failure}"
                with lock:
                    calls.ended.append(Call(caller, begin_s, time.monotonic(), error))
                number += 1
                done.wait(pause_s)

    threads = [threading.Thread(target=call_on, args=it, daemon=True) for it in enumerate(kinds)]
    for thread in threads:
        thread.start()
    try:
        yield calls
    finally:
        done.set()
        for thread in threads:
            thread.join(END_LIMIT_S)
            assert not thread.is_alive()


@dataclass(frozen=True)
class Scenes:
    """Scenes whose calls cost no computing, and the kinds of calls on them.

    Attributes:
        count: how many; calls of different scenes go to different replicas.
        photo: of all references and queries.
        camera: of the photo.
    """

    count: int = 16
    photo: bytes = padded_photo(300_000)
    camera: Camera = CAMERA

    def store(self, client: Client) -> None:
        """Creates the scenes, with two references each."""
        for scene in map(self.scene, range(self.count)):
            client.create_scene(scene)
            client.add_references(scene, [self.reference(f"r{i}") for i in range(2)])

    def remove(self, client: Client) -> None:
        """Deletes the scenes that exist."""
        own = set(map(self.scene, range(self.count)))
        for scene in [it.scene_id for it in client.list_scenes()]:
            if scene in own:
                client.delete_scene(scene)

    def scene(self, number: int) -> str:
        """The id of the scene of a call, by turns."""
        return f"called-{number % self.count}"

    def reference(self, name: str) -> NewReference:
        """A reference of that name."""
        return NewReference(name, self.photo, self.camera, RigidTransform.identity())

    def localize(self, client: Client, number: int, _: Calls) -> None:
        """A kind of call: localizes the photograph."""
        client.localize(self.photo, self.camera, self.scene(number), ("r0", "r1"))

    def get(self, client: Client, number: int, _: Calls) -> None:
        """A kind of call: gets a stored photograph, which must be the right one."""
        assert client.get_reference(self.scene(number), "r0", include_image=True).image == self.photo

    def add(self, client: Client, number: int, calls: Calls) -> None:
        """A kind of call: adds a reference; only one caller may make it."""
        scene, name = self.scene(number), f"added-{number}"
        client.add_reference(scene, self.reference(name))
        calls.acknowledged.append((scene, name))

    def lost(self, client: Client, calls: Calls) -> set[tuple[str, str]]:
        """References that were acknowledged and are not stored."""
        scenes = map(self.scene, range(self.count))
        stored = {(scene, it.reference_id) for scene in scenes for it in client.list_references(scene)}
        return set(calls.acknowledged) - stored
