"""Replicas are killed or redeployed while callers call: how every call ended, and which stored references are lost."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from bench.load.no_op import CAMERA, padded_photo
from bench.load.report import Check
from mapless import Client, ConnectOptions, MaplessError, NewReference, RigidTransform
from mapless.geometry import Camera
from mapless_tools.output_files import markdown_table
from mapless_tools.progress import Progress

from .cluster import Cluster, application, running_cluster
from .database import VARIABLE, database_url

END_LIMIT_S = 60.0


@dataclass(frozen=True)
class Call:
    """A call that has ended, by `time.monotonic`, with all its attempts; `error` is the final one, if any."""

    caller: int
    begin_s: float
    end_s: float
    error: str = ""


@dataclass
class Calls:
    """All calls in the order of their ends, and (scene, reference) of all that was reported as stored."""

    ended: list[Call] = field(default_factory=list)
    acknowledged: list[tuple[str, str]] = field(default_factory=list)

    @property
    def failed(self) -> list[Call]:
        """Those that failed in spite of the client's retries."""
        return [call for call in self.ended if call.error]

    def between(self, begin_s: float, end_s: float) -> "Calls":
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
    """A caller for each kind of call, on a connection of its own with the client's retries, pausing between calls."""
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
    """Scenes whose calls cost no computing, with one photograph for all; calls of each go to other replicas."""

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


MAX_GAP_S = 2.0
"""The bar of the longest wait after a kill."""
NO_OP = "bench.load_ray.no_op:build"
SETTINGS = {"insecure": True, "workers": 1}
SETTLE_S = 3.0
REPLACED_LIMIT_S = 120.0
REDEPLOY_LIMIT_S = 300.0


@dataclass(frozen=True)
class Replacement:
    """One replacement, with the calls in progress from its beginning until a while after its end.

    It lasts until the new replicas served. Errors are of calls that failed in spite of their retries. Durations are
    those of the slowest call in the seconds before, of the slowest of the calls, and the longest time that one caller
    was without an answer.
    """

    duration_s: float
    calls: int
    errors: list[str]
    usual_s: float
    slowest_s: float
    gap_s: float


@dataclass(frozen=True)
class Replacements:
    """All replacements; of `added` references that were acknowledged, `lost` are not stored."""

    events: list[Replacement]
    added: int
    lost: int


def measure_replacements(
    replace: Callable[[Cluster, int], float], count: int, step: str, progress: Progress
) -> Replacements:
    """Replaces replicas of two, `count` times, by `kill_one` or `redeploy`."""
    scenes = Scenes()
    with database_url() as url, running_cluster({VARIABLE: url}) as cluster:
        cluster.deploy(application(SETTINGS, import_path=NO_OP))
        with Client(cluster.address) as client:
            scenes.store(client)
        events = []
        with calling(cluster.address, [scenes.localize, scenes.localize, scenes.get, scenes.add], 0.02) as calls:
            for done in range(count):
                progress(step, done, count)
                events.append(_replacement(replace, cluster, calls, done))
        with Client(cluster.address) as client:
            lost = scenes.lost(client, calls)
    return Replacements(events, len(calls.acknowledged), len(lost))


def _replacement(replace: Callable[[Cluster, int], float], cluster: Cluster, calls: Calls, number: int) -> Replacement:
    time.sleep(SETTLE_S)
    begin_s = time.monotonic()
    duration_s = replace(cluster, number)
    time.sleep(SETTLE_S)
    before = Calls([it for it in calls.between(begin_s - SETTLE_S, begin_s).ended if it.end_s < begin_s])
    meanwhile = calls.between(begin_s, time.monotonic())
    errors = [call.error for call in meanwhile.failed]
    return Replacement(
        duration_s, len(meanwhile.ended), errors, before.slowest_s, meanwhile.slowest_s, meanwhile.longest_gap_s
    )


def kill_one(cluster: Cluster, number: int) -> float:
    """Kills one replica, by turns; gives the time until Serve has another one, seconds."""
    before, begin_s = cluster.replicas(), time.monotonic()
    killed = before[number % len(before)]
    os.kill(killed.process_id, signal.SIGKILL)
    while killed in (now := cluster.replicas()) or len(now) < len(before):
        if time.monotonic() - begin_s > REPLACED_LIMIT_S:
            raise RuntimeError(f"Serve has not replaced the replica\n{cluster.logged()}")
        time.sleep(0.1)
    return time.monotonic() - begin_s


def redeploy(cluster: Cluster, number: int) -> float:
    """Changes a setting, for which Serve replaces all replicas; gives the duration, seconds."""
    before, begin_s = set(cluster.replicas()), time.monotonic()
    settings = SETTINGS | {"max_queued_s": 2.01 + number / 100}
    cluster.deploy(application(settings, import_path=NO_OP), REDEPLOY_LIMIT_S)
    duration_s = time.monotonic() - begin_s
    if left := before.intersection(cluster.replicas()):
        raise RuntimeError(f"not replaced: {left}")
    return duration_s


def replacement_lines(result: Replacements, what: str) -> list[str]:
    """A table with a row for each replacement."""
    lines = [
        f"Two replicas that compute nothing, {what}; 4 callers (two of Localize with 0.3 MB, one of a stored "
        "photograph, one that adds references), each on a connection of its own with the client's usual retries:",
        "",
    ]
    rows = (
        (
            number,
            f"{it.duration_s:.1f}",
            it.calls,
            len(it.errors),
            *(f"{s:.2f}" for s in (it.usual_s, it.slowest_s, it.gap_s)),
        )
        for number, it in enumerate(result.events, 1)
    )
    head = "number | took, s | calls | failed | slowest before, s | slowest call, s | longest gap of a caller, s"
    return [*lines, *markdown_table(head, rows), "", *(f"- {error}" for it in result.events for error in it.errors[:3])]


def failover_checks(result: Replacements) -> list[Check]:
    """The bars after kills."""
    slowest_s = max(max(it.slowest_s, it.gap_s) for it in result.events)
    bar = f"below {MAX_GAP_S:g}"
    wait = Check("longest wait for a retried call, s", f"{slowest_s:.2f}", bar, slowest_s < MAX_GAP_S)
    return [wait, *redeploys_checks(result)]


def redeploys_checks(result: Replacements) -> list[Check]:
    """The bars after redeploys."""
    calls, failed = sum(it.calls for it in result.events), sum(len(it.errors) for it in result.events)
    return [
        Check(f"calls that failed, of {calls}", str(failed), "0", failed == 0),
        Check(f"references lost, of {result.added} acknowledged", str(result.lost), "0", result.lost == 0),
    ]
