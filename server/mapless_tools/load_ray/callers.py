"""Callers that go on calling while replicas come and go: how every call ended, and whether what was stored is lost."""

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
    """One that has ended; `time.monotonic`.

    Attributes:
        caller: who made it.
        begin_s, end_s: with all its retries.
        error: what the caller was told in the end; empty if it was answered.
    """

    caller: int
    begin_s: float
    end_s: float
    error: str = ""

    @property
    def duration_s(self) -> float:
        """Retries and pauses are in it."""
        return self.end_s - self.begin_s


@dataclass
class Calls:
    """All that were made.

    Attributes:
        ended: in order of their end.
        acknowledged: (scene, reference) of all that a caller was told are stored.
    """

    ended: list[Call] = field(default_factory=list)
    acknowledged: list[tuple[str, str]] = field(default_factory=list)

    @property
    def failed(self) -> list[Call]:
        """Those that a caller could not have mended by waiting."""
        return [call for call in self.ended if call.error]

    def between(self, begin_s: float, end_s: float) -> Calls:
        """Those that were in progress at some time between."""
        return Calls([call for call in self.ended if call.end_s >= begin_s and call.begin_s <= end_s])

    @property
    def slowest_s(self) -> float:
        """The longest that a caller waited for one call; 0 if there was none."""
        return max((call.duration_s for call in self.ended), default=0.0)

    @property
    def longest_gap_s(self) -> float:
        """The longest that a caller who always called heard nothing."""
        last: dict[int, float] = {}
        longest_s = 0.0
        for call in self.ended:
            if not call.error:
                longest_s = max(longest_s, call.end_s - last.get(call.caller, call.end_s))
                last[call.caller] = call.end_s
        return longest_s


Make = Callable[[Client, int], None]
"""Makes one call, the so-manyth."""


@contextmanager
def calling(
    address: str, kinds: Sequence[Make], pause_s: float = 0.0, options: ConnectOptions | None = None
) -> Iterator[Calls]:
    """A caller for each kind, with a connection of its own and the client's usual retries, until the block is left.

    Args:
        address: "host:port".
        kinds: of calls.
        pause_s: between a caller's calls.
        options: how they connect; the client's own by default, retries and all.
    """
    calls, done, lock = Calls(), threading.Event(), threading.Lock()

    def call_on(caller: int, make: Make) -> None:
        with Client(address, replace(options or ConnectOptions(), client_id=f"caller-{caller}")) as client:
            number = 0
            while not done.is_set():
                begin_s, error = time.monotonic(), ""
                try:
                    make(client, number)
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
    """Scenes of which nothing is computed, and what to do with them.

    Attributes:
        count: how many; calls of different scenes go to different replicas.
        photo: that all consist of.
        camera: of it.
    """

    count: int = 16
    photo: bytes = padded_photo(300_000)
    camera: Camera = CAMERA

    def store(self, client: Client) -> None:
        """Makes the scenes, with two references each."""
        for scene in map(self.scene, range(self.count)):
            client.create_scene(scene)
            client.add_references(scene, [self.reference(f"r{i}") for i in range(2)])

    def remove(self, client: Client) -> None:
        """Deletes those of them that there are."""
        own = set(map(self.scene, range(self.count)))
        for scene in [it.scene_id for it in client.list_scenes()]:
            if scene in own:
                client.delete_scene(scene)

    def scene(self, number: int) -> str:
        """Its id; they go around."""
        return f"called-{number % self.count}"

    def reference(self, name: str) -> NewReference:
        """A reference of that name."""
        return NewReference(name, self.photo, self.camera, RigidTransform.identity())

    def localize(self, client: Client, number: int) -> None:
        """Asks where a photograph was taken."""
        client.localize(self.photo, self.camera, self.scene(number), ("r0", "r1"))

    def get(self, client: Client, number: int) -> None:
        """Fetches a stored photograph; one that is another is an error."""
        found = client.get_reference(self.scene(number), "r0", include_image=True)
        assert found.image == self.photo

    def adding(self, calls: Callable[[], Calls], caller: str) -> Make:
        """Adds references of its own, and remembers those of which it was told that they are stored."""

        def add(client: Client, number: int) -> None:
            scene, name = self.scene(number), f"{caller}-{number}"
            client.add_reference(scene, self.reference(name))
            calls().acknowledged.append((scene, name))

        return add

    def lost(self, client: Client, calls: Calls) -> set[tuple[str, str]]:
        """What was acknowledged and is not stored."""
        stored = {
            (scene, it.reference_id)
            for scene in map(self.scene, range(self.count))
            for it in client.list_references(scene)
        }
        return set(calls.acknowledged) - stored
