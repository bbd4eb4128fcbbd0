"""Request validation: a call's metadata (ids, tokens, deadlines, certificates), and the file of tokens.

Laws: every call ends once, answered or with a status that a caller can act on, and with one line in the log, a JSON
object; only a token of the file opens anything; a file of tokens that is accepted is the same after it was written.
"""

import asyncio
import json
import logging
import re
from collections.abc import Callable
from datetime import datetime, timezone
from functools import cache
from typing import Any

import grpc

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.observability.logs import JsonFormatter, TextFormatter
from mapless_server.rpc import CLIENT_ID_KEY, REQUEST_ID_KEY, Call, CallGuard
from mapless_server.security import METHOD_ROLES, Authenticator, SecurityError
from mapless_server.security.access import Token, Tokens, sha256_of
from mapless_server.security.tokens import read_tokens

from . import folders
from .target import Target

NOW = datetime(2026, 11, 21, tzinfo=timezone.utc)
GOOD = "mapless_good"
TOKENS = Tokens(
    tokens=(
        Token(name="robot", tenant="acme", role="localize", sha256=sha256_of(GOOD)),
        Token(name="old", role="write", sha256=sha256_of("old"), expires=datetime(2026, 1, 1, tzinfo=timezone.utc)),
        Token(name="reader", role="read", sha256=sha256_of("reader"), scenes=("lobby",), labels={"site": "a"}),
    )
)
_FILE = "tokens.json"
_ALLOWED = frozenset({"OK", "UNAUTHENTICATED", "PERMISSION_DENIED", "INVALID_ARGUMENT", "DEADLINE_EXCEEDED"})
_IDENTIFIER = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)


class Aborted(Exception):
    """The error that grpc raises in a handler that aborted its call."""


class Context:
    """A call with the interface of grpc's."""

    def __init__(self, sent: bytes, limit_s: float | None, certificate: bytes, message: bytes) -> None:
        pairs = (line.partition(b":") for line in sent.split(b"\n"))
        self._metadata = tuple(
            (key.strip().decode("latin1"), value.strip().decode("latin1")) for key, _, value in pairs
        )
        self._limit_s = limit_s
        self._certificate = certificate
        self._message = message
        self.code = ""
        self.trailing: tuple[tuple[str, Any], ...] = ()

    def invocation_metadata(self) -> Any:
        """See grpc.aio.ServicerContext, here and below."""
        return self._metadata

    def auth_context(self) -> Any:
        return {"x509_common_name": [self._certificate]} if self._certificate else {}

    def time_remaining(self) -> float | None:
        return self._limit_s

    def add_done_callback(self, callback: Callable[[object], None]) -> None:
        callback(self)

    def peer(self) -> str:
        return "ipv6:%5B::1%5D:1234"

    async def read(self) -> Any:
        return self._message or grpc.aio.EOF

    def set_trailing_metadata(self, trailing: Any) -> None:
        self.trailing = tuple(trailing)

    async def abort(self, code: grpc.StatusCode, details: str, trailing: Any) -> None:
        self.code, self.trailing = code.name, tuple(trailing)
        raise Aborted(details)


class Lines(logging.Handler):
    """The log's lines since `clear`, in both forms."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[tuple[str, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((JsonFormatter().format(record), TextFormatter().format(record)))


@cache
def _serving() -> tuple[Any, asyncio.AbstractEventLoop, Lines, folders.Folder]:
    async def answer(request: pb.LocalizeRequest, call: Call) -> pb.LocalizeResponse:
        assert call.principal.name == "robot"
        assert call.principal.tenant == "acme"
        assert _IDENTIFIER.fullmatch(call.request_id)
        return pb.LocalizeResponse()

    async def guard() -> CallGuard:
        return CallGuard(authenticate=_authenticate)

    loop = asyncio.new_event_loop()
    method = grpc.unary_unary_rpc_method_handler(
        answer, pb.LocalizeRequest.FromString, pb.LocalizeResponse.SerializeToString
    )
    handler = loop.run_until_complete(guard()).guarded("/mapless.v1.LocalizationService/Localize", method)
    lines = Lines()
    log = logging.getLogger("mapless_server.rpc.guard")
    log.addHandler(lines)
    log.setLevel(logging.INFO)
    log.propagate = False
    return handler.stream_unary, loop, lines, folders.Folder("tokens")


def _authenticate(metadata: Any, method: str, auth_context: Any) -> Any:
    return Authenticator(lambda: TOKENS, lambda: NOW).authenticate(metadata, method, auth_context)


def check(data: bytes) -> bool:
    """See Target."""
    kind, contents = folders.split(data)
    if kind % 2:
        return _check_file(contents[:1])
    sent, limit, certificate, message = [*contents, b"", b"", b"", b""][:4]
    return _check_call(Context(sent, _limit_s(limit), certificate, message))


def _limit_s(text: bytes) -> float | None:
    """As HTTP/2 carries it: at most eight digits and a unit."""
    return float(text) / 1000 if re.fullmatch(rb"[0-9]{1,8}", text) else None


def _check_call(context: Context) -> bool:
    handler, loop, lines, _ = _serving()
    lines.lines.clear()
    try:
        answer = loop.run_until_complete(handler(None, context))
    except Aborted as error:
        assert len(str(error)) <= 1000
    else:
        assert answer == b""
        context.code = "OK"
    assert context.code in _ALLOWED, context.code
    ((as_json, as_text),) = lines.lines
    line = json.loads(as_json)
    assert line["code"] == context.code
    assert "\n" not in as_json
    assert as_json.isprintable()
    assert as_text.isprintable()
    assert dict(context.trailing)[REQUEST_ID_KEY] == line["request_id"]
    assert _IDENTIFIER.fullmatch(line["request_id"])
    assert GOOD not in as_json or GOOD in f"{line['request_id']} {line['client']}"
    given = [value for key, value in context.invocation_metadata() if key == CLIENT_ID_KEY]
    assert line["client"] in ("ipv6:[::1]:1234", *given[:1])
    Authenticator(None).authenticate(context.invocation_metadata(), next(iter(METHOD_ROLES)), context.auth_context())
    return context.code == "OK"


def _check_file(contents: list[bytes]) -> bool:
    *_, folder = _serving()
    folder.write([_FILE], contents)
    file = folder.path / _FILE
    try:
        tokens = read_tokens(file)
    except SecurityError as error:
        assert str(error).isprintable(), str(error)
        assert len(str(error)) < 1000
        return False
    assert Tokens.model_validate_json(tokens.model_dump_json(exclude_none=True)) == tokens
    for token in tokens.tokens:
        if token.limit is None:
            assert (token.scenes, token.labels) == (None, None)
        else:  # never an empty one, which would be read as none
            assert token.limit.scene_ids == frozenset(token.scenes or ())
            assert token.limit.labels == frozenset((token.labels or {}).items())
            assert token.limit.scene_ids or token.limit.labels
        assert tokens.rate_ms(token.tenant) is None or 0 <= (tokens.rate_ms(token.tenant) or 0) < float("inf")
    return True


def _call(sent: str, message: bytes = pb.LocalizeRequest(scene="scenes/a").SerializeToString()) -> bytes:
    return folders.joined(0, [sent.encode(), b"2000", b"client", message])


@cache
def seeds() -> tuple[bytes, ...]:
    """Calls with good and bad tokens, and files."""
    limited = {"tenants": {"acme": {"rate_ms": 500}}, "tokens": [it.model_dump(mode="json") for it in TOKENS.tokens]}
    return (
        _call(f"authorization: Bearer {GOOD}\n{REQUEST_ID_KEY}: abc-1.2\n{CLIENT_ID_KEY}: robot-7"),
        _call(f"authorization: bearer  {GOOD} \ntraceparent: 00-{'1' * 32}-{'2' * 16}-01"),
        _call("authorization: Bearer old"),
        _call("authorization: Bearer reader\nauthorization: Bearer reader"),
        _call(f"{REQUEST_ID_KEY}: a\x1bb\ngrpc-timeout: 1S"),
        folders.joined(1, [json.dumps(limited).encode()]),
        folders.joined(1, [b'{"tokens": [], "tenants": {}}']),
    )


TARGET = Target(
    seeds,
    check,
    folders.mutate,
    max_bytes=4096,
    words=(
        b"authorization",
        b"Bearer ",
        REQUEST_ID_KEY.encode(),
        CLIENT_ID_KEY.encode(),
        GOOD.encode(),
        folders.SEPARATOR,
    )
    + (b'"role": "write"', b'"expires": "2027-01-01T00:00:00Z"', b'"rate_ms": 0', b'"sha256": ', b'"tenants": ')
    + (b'"scenes": ["lobby"]', b'"scenes": []', b'"labels": {"site": "a"}', b'"labels": {}'),
)
