"""Photographs and requests of callers are stored nowhere, unless the operator asks for it: no file, database or log.

Photographs with planted contents go through every method that takes one, answered and refused, to a server in its own
process, which has a home, a folder for temporary files and a working folder of its own. Then whatever it could write is
searched for any 16 bytes in a row of what was sent, and for its pixels and what is found in them. That the search finds
what is there is shown by the same server with `capture_dir`, and by planted pieces.
"""

import inspect
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import grpc
import numpy as np
import psycopg
import pytest
from numpy.typing import NDArray
from support import corner
from support.images import encode, textured
from support.postgres import shared_cluster
from support.programs import Program, program
from support.waiting import wait_until

from mapless import (
    AlreadyExists,
    Client,
    ConnectOptions,
    InvalidArgument,
    LocalizationResult,
    NewReference,
    NotFound,
    Rejected,
    RigImage,
    SequenceFrame,
    wire,
)
from mapless.errors import from_rpc_error
from mapless.v1 import localization_service_pb2
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import make_extractor

SERVICE = "mapless.v1.LocalizationService"
RUN_BYTES = 16
"""So many bytes in a row, of anything that was sent, are a leak: by chance nothing has them."""
ARRAY_RUN_BYTES = 64
"""The same of pixels and features, whose numbers are small and few: references, which are stored, have alike ones."""
HASH_BITS = 22
REFERENCE_ANGLES = (-8, 0, 8)


def marked(photo: bytes, name: str) -> bytes:
    """A JPEG of a PNG's picture with bytes of chance in its comment and, as a camera's, in its EXIF."""
    random = np.random.default_rng(sum(name.encode()))
    pixels = decode_image(photo, ImageLimits())
    jpeg = encode(".jpg", pixels, cv2.IMWRITE_JPEG_QUALITY, 90)
    planted = [b"\xff\xfe", b"\xff\xe1"]
    bodies = [random.bytes(200), b"Exif\0\0" + random.bytes(200)]
    segments = [mark + (len(body) + 2).to_bytes(2, "big") + body for mark, body in zip(planted, bodies, strict=True)]
    return jpeg[:2] + b"".join(segments) + jpeg[2:]


def arrays_of(photo: bytes) -> list[bytes]:
    """Its pixels, and what local features are found in them: descriptors and keypoints, as they would be stored."""
    pixels = decode_image(photo, ImageLimits())
    features = make_extractor("sift").extract(pixels, corner.CAMERA).features
    return [array.tobytes() for array in (pixels, features.descriptors, features.keypoints)]


class Search:
    """Looks for pieces of what must not be there: of photographs 16 bytes in a row, of arrays 64."""

    def __init__(
        self, photos: Sequence[bytes], pixels: Sequence[bytes], features: Sequence[bytes], public: bytes
    ) -> None:
        """Text that stands in `public` too, as the tables of a format do, is no secret."""
        self._photos = photos
        # Wherever so many bytes in a row are, the half of them is that begins at a multiple of that.
        known = {public[i : i + 8] for i in range(len(public) - 7)}
        self._of_photos = {photo[i : i + 8] for photo in photos for i in range(0, len(photo) - 7, 8)} - known
        # Pieces of few different bytes say nothing: plain walls look alike, and most numbers of a descriptor are zero.
        self._of_arrays = _pieces(pixels, 8) | _pieces(features, 16)
        assert min(len(self._of_photos), len(self._of_arrays)) > 1000
        # Zeros say nothing either: files have pages of them.
        beginnings = (self._of_photos | {it[:8] for it in self._of_arrays}) - {bytes(8)}
        self._beginnings = np.sort(np.frombuffer(b"".join(beginnings), np.uint64))
        self._hashes = np.zeros(2**HASH_BITS, bool)
        self._hashes[_hash(self._beginnings)] = True

    def find(self, data: bytes) -> bool:
        """Whether it holds any of it."""
        padded = np.frombuffer(data + bytes(8), np.uint8)
        for offset in range(min(8, len(data))):
            words = padded[offset : offset + (len(data) - offset) // 8 * 8].view(np.uint64)
            likely = np.flatnonzero(self._hashes[_hash(words)])  # few, so that large files take no long search
            places = np.searchsorted(self._beginnings, words[likely]).clip(max=len(self._beginnings) - 1)
            candidates = 8 * likely[self._beginnings[places] == words[likely]] + offset
            if any(self._is_found(data, at) for at in candidates.tolist()):
                return True
        return False

    def _is_found(self, data: bytes, at: int) -> bool:
        if data[at : at + ARRAY_RUN_BYTES // 2] in self._of_arrays:
            return True
        if data[at : at + 8] not in self._of_photos:
            return False
        runs = (data[i : i + RUN_BYTES] for i in range(max(0, at - RUN_BYTES // 2), at + 1))
        return any(len(run) == RUN_BYTES and run in photo for run in runs for photo in self._photos)

    def files(self, folder: Path) -> list[str]:
        """Files with something of it, anywhere in a folder."""
        paths = sorted(it for it in folder.rglob("*") if it.is_file() and not it.is_symlink())
        return [str(it.relative_to(folder)) for it in paths if self.find(it.read_bytes())]


def _hash(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    return (words * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(64 - HASH_BITS)


def _pieces(arrays: Sequence[bytes], different: int) -> set[bytes]:
    half = ARRAY_RUN_BYTES // 2
    pieces = (array[i : i + half] for array in arrays for i in range(0, len(array) - half + 1, half))
    return {it for it in pieces if len(set(it)) > different}


def photograph(angle_deg: float) -> bytes:
    """A query, with marks of its own."""
    return marked(corner.photograph(corner.pose(angle_deg, -1.5)), str(angle_deg))


ANGLES = (-5.0, 3.0)
GOOD = [photograph(angle) for angle in ANGLES]
BLANK = marked(encode(".png", np.full((384, 512, 3), 90, np.uint8)), "blank")
ELSEWHERE = marked(encode(".png", textured(512, 384, seed=9)), "elsewhere")
REFUSED = photograph(1.0)
SENT = [*GOOD, BLANK, ELSEWHERE, REFUSED]


@pytest.fixture(scope="module")
def search() -> Search:
    pixels, *features = zip(*map(arrays_of, (*GOOD, ELSEWHERE, REFUSED)), strict=True)
    # References are stored; what queries have in common with them is that both are JPEGs of the same encoder.
    public = b"".join(marked(corner.photograph(corner.pose(angle)), f"r{angle}") for angle in REFERENCE_ANGLES)
    return Search(SENT, pixels, [it for kind in features for it in kind], public)


@contextmanager
def served(
    folder: Path, prefix: Sequence[str] = (), environment: Mapping[str, str] | None = None, **settings: Any
) -> Iterator[Program]:
    """The real server, whose every folder is within this one."""
    for name in ("home", "tmp", "work", "cache"):
        (folder / name).mkdir(parents=True)
    given = {"port": 0, "metrics_port": 0, "data_dir": folder / "data", "workers": 2} | settings
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in given.items() if value is not None]
    private = {"HOME": "home", "TMPDIR": "tmp", "XDG_CACHE_HOME": "cache"}
    variables = {name: str(folder / place) for name, place in private.items()} | dict(environment or {})
    arguments = ["-m", "mapless_tools", "serve", *flags]
    with program(folder, arguments, prefix, folder / "work", PYTHONDONTWRITEBYTECODE="1", **variables) as running:
        yield running
        running.process.terminate()
        running.wait()


def ask_everything(address: str) -> None:
    """Sends the photographs by every method that takes one, so that they are answered, rejected and refused."""
    camera = corner.CAMERA
    with Client(address, ConnectOptions(max_attempts=1)) as client, grpc.insecure_channel(address) as channel:
        client.create_scene("corner")
        for angle in REFERENCE_ANGLES:
            photo = marked(corner.photograph(corner.pose(angle)), f"r{angle}")
            client.add_reference("corner", NewReference(f"r{angle + 8}", photo, camera, corner.pose(angle)))
        stub = LocalizationServiceStub(channel)

        def request(photo: bytes) -> pb.LocalizeRequest:
            return pb.LocalizeRequest(scene="scenes/corner", image=photo, intrinsics=wire.camera_to_message(camera))

        assert isinstance(client.localize(GOOD[0], camera, "corner"), LocalizationResult)
        assert isinstance(
            client.localize(GOOD[1], camera, "corner", ["r0", "r8"], include_debug=True), LocalizationResult
        )
        assert isinstance(client.localize(BLANK, camera, "corner"), Rejected)
        assert isinstance(client.localize(ELSEWHERE, camera, "corner", variant="full"), Rejected)
        assert [it.is_final for it in stub.LocalizeProgressively(request(GOOD[0]), timeout=60)][-1]
        posed = [(photo, camera, corner.pose(angle, -1.5)) for photo, angle in zip(GOOD, ANGLES, strict=True)]
        client.localize_rig([RigImage(*it) for it in posed], "corner")
        client.localize_sequence([SequenceFrame(*it) for it in posed], "corner")
        assert client.retrieve_references(GOOD[0], camera, "corner", 2)
        assert len(list(client.audit_scene("corner"))) == len(REFERENCE_ANGLES)
        client.check_coverage("corner", corner.pose(2.0), camera)
        with pytest.raises(InvalidArgument):
            client.localize(REFUSED[: len(REFUSED) // 2], camera, "corner")
        with pytest.raises(InvalidArgument):
            client.localize(b"\x00" + REFUSED, camera, "corner")
        with pytest.raises(NotFound):
            client.localize(REFUSED, camera, "nowhere")
        with pytest.raises(InvalidArgument):
            client.add_reference("corner", NewReference("bad", REFUSED[:-400], camera, corner.pose(1.0)))
        with pytest.raises(AlreadyExists):
            client.add_reference("corner", NewReference("r0", REFUSED, camera, corner.pose(1.0)))
        with pytest.raises(grpc.RpcError) as failed:  # the photograph in place of a message
            channel.stream_unary(f"/{SERVICE}/Localize")(iter([REFUSED]), timeout=30)
        assert isinstance(from_rpc_error(failed.value), InvalidArgument)
        with pytest.raises(grpc.RpcError):
            stub.Localize(request(REFUSED), timeout=0.02)
        given_up = stub.Localize.future(request(REFUSED), timeout=30)
        given_up.cancel()
        with pytest.raises(grpc.RpcError):
            next(stub.WatchQueries(pb.WatchQueriesRequest(scene="scenes/corner"), timeout=30))


def open_files(process_id: int) -> list[bytes]:
    """The open files of a process, deleted ones among them."""
    found = []
    for entry in Path(f"/proc/{process_id}/fd").iterdir():
        with suppress(OSError):
            if entry.is_file():
                found.append(entry.read_bytes())
    return found


def test_every_method_that_takes_a_photograph_is_asked() -> None:
    """Those of the service that answers queries; the other one stores references, which is their purpose."""
    methods = localization_service_pb2.DESCRIPTOR.services_by_name["LocalizationService"].methods
    taking = {method.name for method in methods if _takes_an_image(method.input_type)}
    source = inspect.getsource(ask_everything)
    assert taking == {"Localize", "LocalizeProgressively", "LocalizeRig", "LocalizeSequence"}
    for called in ("localize", "localize_rig", "localize_sequence"):
        assert f"client.{called}(" in source
    assert "stub.LocalizeProgressively(" in source


def _takes_an_image(message: Any) -> bool:
    return any(
        field.name == "image" or (field.message_type is not None and _takes_an_image(field.message_type))
        for field in message.fields
    )


@pytest.mark.parametrize(
    "settings", [{"log_level": "debug"}, pytest.param({"log_format": "text"}, marks=pytest.mark.nightly)]
)
def test_files_and_the_log_have_nothing_of_what_was_sent(tmp_path: Path, search: Search, settings: Any) -> None:
    """While the server runs, which has a database with a log of its own, and when it has ended."""
    with served(tmp_path, **settings) as server:
        ask_everything(server.address)
        assert not [data for data in open_files(server.process.pid) if search.find(data)]
        assert search.files(tmp_path) == []
        assert "Localize OK" in server.log
    assert search.files(tmp_path) == []
    assert (tmp_path / "data" / "mapless.sqlite3").stat().st_size > 100_000
    assert list((tmp_path / "tmp").iterdir()) == list((tmp_path / "work").iterdir()) == []
    assert list((tmp_path / "home").iterdir()) == []


@pytest.mark.nightly
def test_a_shared_database_has_nothing_of_what_was_sent(tmp_path: Path, search: Search) -> None:
    cluster = shared_cluster()
    url = cluster.fresh_url()
    with served(tmp_path, environment={"MAPLESS_DATABASE_URL": url}, data_dir=None) as server:
        ask_everything(server.address)
    with psycopg.connect(url) as connection:
        tables = connection.execute(
            "SELECT table_name FROM information_schema.tables WHERE table_schema = current_schema()"
        ).fetchall()
        contents = {str(name): copied(connection, str(name)) for (name,) in tables}
    assert {"scene", "reference", "image", "features"} <= contents.keys()
    assert [name for name, content in contents.items() if search.find(content)] == []
    reference = marked(corner.photograph(corner.pose(0)), "r0")
    assert reference in contents["image"]
    assert search.files(tmp_path) == []


def copied(connection: psycopg.Connection[Any], table: str) -> bytes:
    """Every byte of a table."""
    with connection.cursor().copy(f'COPY "{table}" TO STDOUT (FORMAT BINARY)') as copy:
        return b"".join(map(bytes, copy))


@pytest.mark.nightly
def test_the_search_finds_what_is_captured(tmp_path: Path, search: Search) -> None:
    """The same server with capture: then the photographs are there, in that folder and nowhere else."""
    with served(tmp_path, capture_dir=tmp_path / "captured") as server:
        ask_everything(server.address)
        wait_until(lambda: len(search.files(tmp_path)) >= 7)
        assert "calls are captured, photographs and all" in server.log
    assert {Path(it).parts[0] for it in search.files(tmp_path)} == {"captured"}


@pytest.mark.parametrize("what", ["photograph", "comment", "pixels", "descriptors"])
def test_the_search_finds_a_piece_of_anything(search: Search, what: str) -> None:
    """Wherever it lies, and however little there is of it."""
    pixels, descriptors = arrays_of(GOOD[0])[:2]
    middle = len(GOOD[0]) // 2
    pieces = {
        "photograph": GOOD[0][middle + 3 : middle + 3 + RUN_BYTES],
        "comment": GOOD[0][7 : 7 + RUN_BYTES],
        "pixels": pixels[100_001 : 100_001 + 1536],
        "descriptors": descriptors[:512],
    }
    around = np.random.default_rng(0).bytes(100_003)
    assert not search.find(around)
    for position in range(8):
        assert search.find(around[:position] + pieces[what] + around[:-position])


@pytest.mark.nightly
def test_nothing_is_opened_for_writing_elsewhere(tmp_path: Path, search: Search) -> None:
    """As the kernel saw it: the server writes to its own folders and to no other, not even for a moment."""
    strace = shutil.which("strace")
    if strace is None or subprocess.run([strace, "-o", "/dev/null", "true"], capture_output=True).returncode:
        pytest.skip("needs strace, and to be allowed to use it")
    trace = tmp_path / "trace"
    calls = "trace=open,openat,creat,memfd_create,rename,renameat,renameat2,link"
    options = ["-D", "-f", "-qq", "-y", "-s", "4096", "-e", calls]
    with served(tmp_path / "server", prefix=[strace, *options, "-o", str(trace)]) as server:
        ask_everything(server.address)
    lines = [line for line in trace.read_text().splitlines() if not re.search(r" = -1 |resumed|unfinished", line)]
    changes = re.compile(r"O_WRONLY|O_RDWR|O_CREAT|O_TMPFILE|memfd_create|creat\(|rename|link\(")
    writing = [line for line in lines if changes.search(line)]
    data = str(tmp_path / "server" / "data")
    allowed = re.compile(rf'"({re.escape(data)}/|/dev/(null|urandom|shm/)|/proc/)')
    assert any(f"{data}/mapless.sqlite3" in line for line in writing)
    assert [line for line in writing if not allowed.search(line)] == []
    assert search.files(tmp_path / "server") == []
