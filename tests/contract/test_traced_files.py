"""In how many files a warm Localize is computed: what one has to read to follow it."""

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from support.servers import serving_really

import mapless_server
from mapless import Client, LocalizationResult
from mapless_tools.demo.photographs import room

ROOT = Path(mapless_server.__file__).parent
ROOMS = ("engine/", "method/")
MOST_FILES = 42
BESIDE = ("background", "agreement")
"""Threads that compute for no call."""
CALLS = 2
"""Work that the clock starts may run beside one of them, hardly beside both."""


class Tracer:
    """Notes the files of the server in which a function is entered, in all threads that begin after it."""

    def __init__(self) -> None:
        self._entered: set[tuple[int, str]] | None = None

    def __call__(self, frame: FrameType, event: str, _: Any) -> None:
        """Python's profile function."""
        if event == "call" and (entered := self._entered) is not None:
            entered.add((threading.get_ident(), frame.f_code.co_filename))

    @contextmanager
    def noting(self) -> Iterator[set[str]]:
        """A set that has, after the block, the files of functions entered in it, as paths from the package."""
        entered: set[tuple[int, str]] = set()
        found: set[str] = set()
        self._entered = entered
        try:
            yield found
        finally:
            self._entered = None
            beside = {it.ident for it in threading.enumerate() if it.name.startswith(BESIDE)}
            files = {Path(file) for thread, file in list(entered) if thread not in beside}
            found |= {str(it.relative_to(ROOT)) for it in files if it.is_relative_to(ROOT)}


@contextmanager
def traced() -> Iterator[Tracer]:
    """A tracer of this thread and of those that begin in the block."""
    tracer = Tracer()
    before = threading.getprofile(), sys.getprofile()
    threading.setprofile(tracer)
    sys.setprofile(tracer)
    try:
        yield tracer
    finally:
        threading.setprofile(before[0])
        sys.setprofile(before[1])


def test_files_of_engine_and_method_in_a_warm_localize(tmp_path: Path) -> None:
    place = room()
    query = place.queries[0]
    settings: dict[str, Any] = {"features": "sift", "backend": "geometric", "background_matching": False}
    with (
        traced() as tracer,
        serving_really(tmp_path, **settings) as server,
        Client(server.address) as client,
    ):
        client.create_scene("room")
        client.add_references("room", [it.reference() for it in place.references[::2]])

        def asked() -> set[str]:
            with tracer.noting() as found:
                answer = client.localize(query.data, query.camera, "room")
            assert isinstance(answer, LocalizationResult)
            return found

        asked()
        files = set.intersection(*(asked() for _ in range(CALLS)))
    counted = in_rooms(files)
    assert "method/solve.py" in counted
    assert len(counted) <= MOST_FILES, (
        f"{len(counted)} files, and {len(files - counted)} of other rooms:\n"
        + "\n".join([*sorted(counted), "", *sorted(files - counted)])
    )


def in_rooms(files: set[str]) -> set[str]:
    """Those of the rooms that compute a query, without the queue, the store and what receives and sends."""
    return {it for it in files if it.startswith(ROOMS)}
