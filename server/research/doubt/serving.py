"""A server whose background work has ended, and its answers."""

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from mapless import Client, NotFound
from mapless_tools.child import CONNECT, ChildServer, child_server
from research.contradictions.asking import Row, ask, store
from research.places import Place

from .cases import Asked

QUIET_S = 6.0
"""The server looks for new work every 2 s, and begins it after 1 s without callers."""
QUIET_SHARE = 0.02
REPORT_EVERY_S = 60.0


def answers(asked: Sequence[Asked], kept: Path | None = None) -> Iterator[Row]:
    """Stores the places of all cases, waits until the server computes nothing more, and asks.

    Before the first photograph of a place, one of its references is asked, so that what a server keeps in memory is
    there. `kept` is the folder of a store that remains; None for one that is deleted. ServerFailed as of
    `child_server`, MaplessError if references cannot be stored.
    """
    places = {it.case.place.scene: it.case.place for it in asked}
    with ExitStack() as stack:
        folder = kept or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mapless-doubt-")))
        server = stack.enter_context(child_server(folder))
        client = stack.enter_context(Client(server.address, CONNECT))
        for place in places.values():
            _store_missing(client, place)
        wait_until_idle(server)
        warm = set[str]()
        for it in asked:
            place = it.case.place
            if place.scene not in warm:
                warm.add(place.scene)
                reference = place.reference_frames[0]
                client.localize(reference.image_path, reference.camera, place.scene)
            yield {**ask(server, client, it.case), **it.fields}


def _store_missing(client: Client, place: Place) -> None:
    """Stores a place unless the store has it; one that is incomplete is stored again."""
    try:
        if sum(1 for _ in client.list_references(place.scene)) == len(place.reference_frames):
            return
        client.delete_scene(place.scene)
    except NotFound:
        pass
    store(client, place)


def wait_until_idle(server: ChildServer) -> None:
    """Waits until no thread but the main one has wanted a processor in `QUIET_S`: references are described and matched.

    The main thread has the event loop, whose timers never rest.
    """
    begin_s = reported_s = time.monotonic()
    while True:
        before_s = _wanted_s(server)
        time.sleep(QUIET_S)
        if all(wanted_s - before_s.get(it, 0.0) <= QUIET_SHARE * QUIET_S for it, wanted_s in _wanted_s(server).items()):
            return
        if time.monotonic() - reported_s >= REPORT_EVERY_S:
            reported_s = time.monotonic()
            waited_s = reported_s - begin_s
            print(f"{waited_s:.0f} s: the server still works on its references", file=sys.stderr, flush=True)


def _wanted_s(server: ChildServer) -> dict[str, float]:
    """Seconds that each thread but the main one has run, or has waited for a processor, by /proc/PID/task/TID."""
    found = {}
    for task in Path(f"/proc/{server.process_id}/task").iterdir():
        with suppress(OSError):  # a thread that has ended meanwhile
            run_ns, waited_ns, _ = map(int, (task / "schedstat").read_text().split())
            found[task.name] = (run_ns + waited_ns) / 1e9
    found.pop(str(server.process_id), None)
    return found
