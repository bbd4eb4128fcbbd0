"""The processor time that refusing a call costs the server, beside a bare server that ends calls at once."""

import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import cv2
import grpc
import numpy as np

from bench.search_path import with_search_path
from bench.turns.servers import processor_s
from mapless import Camera, Client, RigidTransform
from mapless.errors import from_rpc_error
from mapless_server.bounds import check_bounds
from mapless_server.security import create_token
from mapless_tools.child import CONNECT, ChildServer, child_module, child_server
from mapless_tools.demo import Photograph
from mapless_tools.output_files import markdown_table
from mapless_tools.progress import Progress, tracked

from . import no_op
from .driving import METHOD, photo_request, store_references
from .echo import REFUSED_METHOD, SHORT_METHOD
from .report import Check
from .sender import MAX_MESSAGE_BYTES

MAX_REFUSAL_MS = 0.3
_PLAIN = {"MAPLESS_WARM_UP": "false", "MAPLESS_FEATURES": "sift", "MAPLESS_BACKGROUND_MATCHING": "false"}
_QUOTA = {"MAPLESS_TENANT_RATE_MS": "1", "MAPLESS_TENANT_BURST_MS": "1"}
_SMALL_MESSAGES = {"MAPLESS_MAX_MESSAGE_MIB": "1", "MAPLESS_MAX_IMAGE_MIB": "1"}

_NOISE_CAMERA = Camera(1024, 768, 900.0, 900.0, 511.5, 383.5)


@dataclass(frozen=True)
class RefusalOptions:
    """Calls of each kind in a round; the servers take turns in rounds. A photograph of 0.3 MB is a phone's.

    So many refusals are not delayed, see `rpc.sending.BURST`; the pause lets as many more be sent at once.
    """

    calls: int = 40
    rounds: int = 6
    pause_s: float = 1.0
    message_bytes: int = 300_000

    def __post_init__(self) -> None:
        check_bounds(self, "calls rounds message_bytes", at_least=1)


@dataclass(frozen=True)
class Refused:
    """How calls were refused, and the server's processor time of each in the median round, milliseconds.

    `beyond_bare_ms` is the part that a bare server does not take for a call with the same message.
    """

    kind: str
    code: str
    processor_ms: float
    beyond_bare_ms: float


@dataclass(frozen=True)
class _Kind:
    name: str
    server: ChildServer
    method: str
    request: bytes
    metadata: tuple[tuple[str, str], ...] = ()
    timeout_s: float = 30.0
    bare: int = 0  # the number of the kind of a bare server that it is compared with


def measure_refusals(options: RefusalOptions, progress: Progress) -> list[Refused]:
    """Refuses calls of each kind, by turns; RuntimeError if one is answered."""
    with ExitStack() as stack:
        kinds = list(_kinds(stack, options))
        calls = [stack.enter_context(_caller(kind)) for kind in kinds]
        codes = [call() for call in calls]
        found: list[list[float]] = [[] for _ in kinds]
        for _ in tracked("refusals, rounds", range(options.rounds), options.rounds, progress):
            for call, kind, spent_ms in zip(calls, kinds, found, strict=True):
                spent_ms.append(1e3 * _cost_s(call, kind.server, options))
    return [
        Refused(it.name, code, median(ms), median(a - b for a, b in zip(ms, found[it.bare], strict=True)))
        for it, code, ms in zip(kinds, codes, found, strict=True)
    ]


def _kinds(stack: ExitStack, options: RefusalOptions) -> Iterator[_Kind]:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mapless-load-")))
    tokens = folder / "tokens.json"
    create_token(tokens, "robot", "fleet", "localize", None)
    photo = no_op.padded_photo(options.message_bytes)
    request = photo_request(photo, no_op.CAMERA, [])
    bare = stack.enter_context(child_module("bench.load.echo", environment=with_search_path()))
    yield _Kind("bare server that aborts", bare, REFUSED_METHOD, request)
    small = stack.enter_context(child_module("bench.load.echo", str(2**20), environment=with_search_path()))
    large = photo_request(bytes(3 * 2**20), no_op.CAMERA, [])
    yield _Kind("bare server, too large a message", small, SHORT_METHOD, large, bare=1)

    def server(name: str, environment: dict[str, str]) -> ChildServer:
        return stack.enter_context(child_server(folder / name, environment=_PLAIN | environment))

    guarded = server("guarded", {"MAPLESS_TOKENS_FILE": str(tokens)})
    yield _Kind("no token", guarded, METHOD, request)
    yield _Kind("wrong token", guarded, METHOD, request, (("authorization", "Bearer mpl_wrong"),))
    spent = server("spent", _QUOTA)
    with Client(spent.address, CONNECT) as client:
        store_references(client, [Photograph("r", _noise(), _NOISE_CAMERA, RigidTransform.identity())])
    yield _Kind("overload: the tenant's computing time is spent", spent, METHOD, request)
    plain = server("plain", _SMALL_MESSAGES)
    yield _Kind("unknown scene, after the message", plain, METHOD, request)
    yield _Kind("too large a message", plain, METHOD, large, bare=1)
    yield _Kind("deadline of 1 ms", plain, METHOD, request, timeout_s=0.001)


def _noise() -> bytes:
    """A photograph that takes longer to describe than a quota gives in minutes."""
    pixels = np.random.default_rng(0).integers(0, 255, (_NOISE_CAMERA.height_px, _NOISE_CAMERA.width_px, 3), np.uint8)
    return bytes(cv2.imencode(".jpg", pixels)[1])


@contextmanager
def _caller(kind: _Kind) -> Iterator[Callable[[], str]]:
    """A function that makes the call, and returns how it ended."""
    sizes = [("grpc.max_send_message_length", MAX_MESSAGE_BYTES), ("grpc.enable_retries", 0)]
    with grpc.insecure_channel(kind.server.address, sizes) as channel:
        grpc.channel_ready_future(channel).result(30)
        method = channel.unary_unary(kind.method)

        def call() -> str:
            try:
                method(kind.request, timeout=kind.timeout_s, metadata=kind.metadata)
            except grpc.RpcError as error:
                known = from_rpc_error(error)
                return f"{known.code} {known.reason}".strip()
            raise RuntimeError(f"{kind.name}: the call was answered")

        yield call


def _cost_s(call: Callable[[], str], server: ChildServer, options: RefusalOptions) -> float:
    """Processor time of a call."""
    time.sleep(options.pause_s)
    begin_s = processor_s(server.process_id)
    for _ in range(options.calls):
        call()
    return (processor_s(server.process_id) - begin_s) / options.calls


def refusal_lines(found: list[Refused], options: RefusalOptions) -> list[str]:
    """A table with a row for each kind."""
    head = "refusal | status | server CPU ms/call | beyond the bare server"
    rows = [(it.kind, it.code, f"{it.processor_ms:.2f}", f"{it.beyond_bare_ms:.2f}") for it in found]
    lead = f"Messages of {options.message_bytes / 1e6:g} MB, {options.rounds} rounds of {options.calls} calls by turns:"
    return [lead, "", *markdown_table(head, rows), ""]


def refusal_checks(found: list[Refused]) -> list[Check]:
    """The bar, for refusals before the message is read: gRPC's own part of a call is that of the bare server."""
    before = [it for it in found if "after the message" not in it.kind]
    worst = max(before, key=lambda it: it.beyond_bare_ms)
    return [
        Check(
            "processor time of a refusal before the message is read, beyond a bare server's, the worst kind",
            f"{worst.beyond_bare_ms:.2f} ms ({worst.kind})",
            f"at most {MAX_REFUSAL_MS:g} ms",
            worst.beyond_bare_ms <= MAX_REFUSAL_MS,
        )
    ]
