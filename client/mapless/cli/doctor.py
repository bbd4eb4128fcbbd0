"""`mapless doctor`: checks a connection step by step, and says how to correct what is wrong."""

import argparse
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib.metadata import version

import grpc
import numpy as np

from ..addresses import addresses_of, host_and_port, is_loopback
from ..answers import Rejected
from ..client import Client
from ..connection import VERSION_KEY
from ..errors import DeadlineExceeded, MaplessError, from_rpc_error
from ..options import ConnectOptions
from ..proxies import Proxy, proxy_of
from ..reaching import connection_fault, speaks_tls
from ..results import Reference
from ..v1 import localization_service_pb2 as localization_pb
from ..v1 import reference_service_pb2 as pb
from ..v1.localization_service_pb2_grpc import LocalizationServiceStub
from ..v1.reference_service_pb2_grpc import ReferenceServiceStub
from .folder import EXIT_FAILED
from .output import serving_states, show, suggesting

OK, WRONG, NOTE, SKIPPED = "ok", "wrong", "note", "skipped"

_CALL_LIMIT_S = 10.0
_QUERY_LIMIT_S = 30.0
_PROXY_LIMIT_S = 3.0
_MAX_OFFSET_S = 5.0
"""Largest offset of two clocks. Certificates and tokens expire, and times of captures are compared, by minutes at the
least."""
_MAX_ERROR = 0.05
"""Largest error of a reference's photograph, matched with itself, from its stored pose; metres or units."""
_TIME_KEY, _CONNECTIONS_KEY = "x-mapless-time", "x-mapless-connections"
_FEW_CONNECTIONS = 4096


@dataclass(frozen=True)
class Finding:
    """Result of a check: `state` is "ok", "wrong", "note" or "skipped"; `advice` what to do, or empty.

    `address` is that of the server.
    """

    check: str
    state: str
    message: str = ""
    advice: str = ""
    address: str = ""


@dataclass
class _Session:
    """Values that the checks share; `trailers` and `clock_error_s` are known after `_check_token`."""

    client: Client
    scene: str | None
    trailers: dict[str, str] = field(default_factory=dict)
    sent_s: float = 0.0
    answered_s: float = 0.0


def run(client: Client, arguments: argparse.Namespace) -> int:
    """Makes all checks of each address, and prints their findings."""
    options = replace(client.options, timeout_s=min(client.options.timeout_s, _CALL_LIMIT_S), max_attempts=1)
    addresses = addresses_of(arguments.address)
    findings: list[Finding] = []
    text: list[str] = []
    for address in addresses:
        found = _examined(address, options, arguments.scene)
        findings += found
        text += ["", address][not text :] if len(addresses) > 1 else []
        text += [line for it in found for line in _lines(it)]
    show(arguments, findings, text)
    return EXIT_FAILED if any(it.state == WRONG for it in findings) else 0


def _examined(address: str, options: ConnectOptions, scene: str | None) -> list[Finding]:
    findings: list[Finding] = []
    with Client(address, options) as own:
        session = _Session(own, scene)
        for check, (examine, _) in _CHECKS.items():
            if any(it.state == WRONG and _CHECKS[it.check][1] for it in findings):
                findings.append(Finding(check, SKIPPED, address=address))
                continue
            try:
                with suggesting(own):
                    state, message, advice = examine(session)
            except MaplessError as error:
                where = f"the server's log has more, under {error.request_id}" if error.request_id else ""
                state, message, advice = WRONG, str(error), _ADVICE.get(error.reason, where)
            findings.append(Finding(check, state, message, advice, address))
    return findings


def _lines(it: Finding) -> list[str]:
    return [f"{it.state:7}  {it.check:8}  {it.message}".rstrip(), *([f"{'':19}{it.advice}"] if it.advice else [])]


_Result = tuple[str, str, str]
"""State, message and advice."""


def _check_address(session: _Session) -> _Result:
    """Resolves the host's name and connects to each of its addresses."""
    host, port = host_and_port(session.client.address)
    if proxy := proxy_of(session.client.address):
        return _of_proxy(proxy)
    if not host:
        return NOTE, f"{session.client.address} has a form of gRPC's own, which is not examined", ""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        advice = "check the spelling of --address (or MAPLESS_ADDRESS), and the network's name server"
        return WRONG, f"the name {host} cannot be resolved: {getattr(error, 'strerror', None) or error}", advice
    faults = {str(endpoint[0]): connection_fault(family, endpoint) for family, *_, endpoint in found}
    if None in faults.values():
        reached = next(ip for ip, fault in faults.items() if fault is None)
        return OK, f"{reached} port {port} accepts connections", ""
    refused = "; ".join(f"{ip}: {fault.strerror or 'no answer'}" for ip, fault in faults.items() if fault)
    advice = f"start the server (mapless-server serve), or correct --address (host:port); is port {port} open?"
    return WRONG, f"nothing answers at {session.client.address} ({refused})", advice


def _of_proxy(proxy: Proxy) -> _Result:
    """Connects to the proxy, which resolves the server's name and connects to it."""
    advice = f"no_proxy=HOST exempts the server's host, an empty {proxy.variable} all"
    host, port = host_and_port(proxy.address)
    try:
        socket.create_connection((host, port), _PROXY_LIMIT_S).close()
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        return WRONG, f"calls go through {proxy}, and that cannot be reached: {reason}", advice
    return NOTE, f"calls go through {proxy}", advice


def _check_protocol(session: _Session) -> _Result:
    """Makes a gRPC call, encrypted or not as the options say."""
    tls = session.client.options.tls
    try:
        session.client.is_serving()
    except DeadlineExceeded:
        return WRONG, "connections are accepted, but nothing answers", "the server hangs, or it is no gRPC server"
    except MaplessError as error:
        if error.code != "UNAVAILABLE" or not error.message.startswith("cannot connect"):
            raise
        failed = error.message.partition(": ")[2]
        if proxy_of(session.client.address):
            return WRONG, error.message, "no_proxy=HOST exempts the server's host from the proxy"
        is_known = bool(host_and_port(session.client.address)[0])
        has_tls = is_known and speaks_tls(session.client.address)
        if has_tls and not tls:
            advice = "give --tls, or --ca FILE with the authority's certificate"
            return WRONG, "the server uses TLS, and --tls is not given", advice
        if tls and is_known and not has_tls and "SETTINGS" not in failed:
            advice = "leave out --tls, --ca and --cert, or give the server a certificate"
            return WRONG, "the server does not use TLS", advice
        advice = "give --cert and --key where the server requires a client certificate" if "closes" in failed else ""
        return WRONG, failed, advice
    if tls:
        return OK, "gRPC, encrypted, and the server's certificate is valid", ""
    if session.client.options.token is None or is_loopback(session.client.address):
        return OK, "gRPC, not encrypted", ""
    advice = "serve with TLS (settings tls_certificate and tls_key)"
    return NOTE, "gRPC, not encrypted: the token is sent in clear text", advice


def _check_services(session: _Session) -> _Result:
    states = serving_states(session.client, "the server")
    silent = [name for name, is_serving in states.items() if not is_serving]
    if not silent:
        return OK, "serving", ""
    advice = _advice_of_silent(session) if "the server" in silent else "the store cannot be written: see the log"
    return WRONG, f"not serving: {', '.join(silent)}", advice


def _advice_of_silent(session: _Session) -> str:
    """Asks for nothing to be localized: the error says whether the server starts, and what it does, or stops."""
    options = session.client.options
    with options.channel(session.client.address) as channel:
        method, request = LocalizationServiceStub(channel).Localize, localization_pb.LocalizeRequest()
        try:
            method(request, timeout=options.timeout_s, metadata=options.metadata())
        except grpc.RpcError as call:
            error = from_rpc_error(call)
            if error.reason == "STARTING":
                return f"{error.message}: wait until it is ready, some seconds"
            if error.code in ("UNAVAILABLE", "UNAUTHENTICATED", "PERMISSION_DENIED"):
                return _ADVICE.get(error.reason, "wait while it starts or stops")
    return "it stops soon, and answers until then: use another server"


def _check_token(session: _Session) -> _Result:
    """Lists one scene, which every role may do; keeps the trailers."""
    options = session.client.options
    with options.channel(session.client.address) as channel:
        method, request = ReferenceServiceStub(channel).ListScenes, pb.ListScenesRequest(page_size=1)
        session.sent_s = time.time()
        try:
            _, call = method.with_call(request, timeout=options.timeout_s, metadata=options.metadata())
        except grpc.RpcError as error:
            raise from_rpc_error(error) from error
        session.answered_s = time.time()
        session.trailers = {str(key): str(value) for key, value in call.trailing_metadata() or ()}
    return OK, "accepted" if options.token else "none given, and none is needed", ""


def _check_clock(session: _Session) -> _Result:
    """Compares the clocks of client and server, to within the duration of the call."""
    try:
        server_s = float(session.trailers.get(_TIME_KEY, ""))
    except ValueError:
        return NOTE, "the server, or a proxy before it, does not send its time", ""
    offset_s = (session.sent_s + session.answered_s) / 2 - server_s
    if abs(offset_s) - (session.answered_s - session.sent_s) / 2 <= _MAX_OFFSET_S:
        return OK, f"within {max(abs(offset_s), 0.1):.1f} s of the server's", ""
    direction = "ahead of" if offset_s > 0 else "behind"
    advice = "synchronize both machines (NTP): certificates and tokens expire by the clock"
    return WRONG, f"this machine's clock is {abs(offset_s):.0f} s {direction} the server's", advice


def _check_version(session: _Session) -> _Result:
    libraries = f"grpcio {version('grpcio')}, protobuf {version('protobuf')}"
    client, server = version("mapless"), session.trailers.get(VERSION_KEY, "")
    if not server:
        return NOTE, f"client {client} ({libraries}); the server's is not known", ""
    if server == client:
        return OK, f"client and server {client} ({libraries})", ""
    advice = "they work together; what only one of them knows is ignored"
    return NOTE, f"client {client}, server {server} ({libraries})", advice


def _check_limits(session: _Session) -> _Result:
    """Reads how many connections the server accepts at a time."""
    text = session.trailers.get(_CONNECTIONS_KEY, "")
    if not text.isdecimal():
        return NOTE, "the server does not say how many connections it accepts", ""
    if int(text) >= _FEW_CONNECTIONS:
        return OK, f"the server accepts {text} connections at a time", ""
    advice = "raise the hard limit of its file descriptors (LimitNOFILE, --ulimit nofile)"
    return NOTE, f"the server accepts {text} connections at a time: as many idle ones keep others out", advice


def _check_query(session: _Session) -> _Result:
    """Localizes a reference's photograph in its own scene."""
    client = session.client
    scene = session.scene or next((it.scene_id for it in client.list_scenes() if it.reference_count), None)
    known: Reference | None = next(client.list_references(scene, page_size=1), None) if scene else None
    if scene is None or known is None:
        there = f"scene {scene} has no references" if scene else "no scene has references"
        advice = "add some: mapless reference add, or mapless-server import"
        return NOTE, f"{there}, so nothing can be localized", advice
    reference = client.get_reference(scene, known.reference_id, include_image=True)
    start_s = time.monotonic()
    answer = client.localize(reference.image or b"", reference.camera, scene, timeout_s=_QUERY_LIMIT_S)
    took = f"in {time.monotonic() - start_s:.2f} s"
    what = f"the photograph of reference {reference.reference_id} of scene {scene}"
    if isinstance(answer, Rejected):
        advice = answer.hint.message if answer.hint else ""
        return WRONG, f"{what} was not localized: {answer.reason}, {answer.message}", advice
    error = float(np.linalg.norm(answer.world_from_camera.translation - reference.world_from_camera.translation))
    unit = "units" if answer.arbitrary_unit else "m"
    if error > _MAX_ERROR:
        message = f"{what} was localized {error:.3f} {unit} from its stored pose, {took}"
        return NOTE, message, f"mapless-server audit {scene}"
    return OK, f"{what} was localized {took}, {error:.3f} {unit} from its stored pose", ""


_CHECKS: dict[str, tuple[Callable[[_Session], _Result], bool]] = {
    "address": (_check_address, True),
    "protocol": (_check_protocol, True),
    "services": (_check_services, True),
    "token": (_check_token, True),
    "clock": (_check_clock, False),
    "version": (_check_version, False),
    "limits": (_check_limits, False),
    "query": (_check_query, False),
}
"""The checks in their order, and whether those after it need it."""

_TOKENS = "give it with --token-file or in MAPLESS_TOKEN; `mapless-server token create` makes one"
_ADVICE = {
    "TOKEN_MISSING": _TOKENS,
    "TOKEN_INVALID": _TOKENS,
    "TOKEN_EXPIRED": _TOKENS,
    "NOT_FOUND": "`mapless scene list` lists the scenes that there are",
    "ROLE_TOO_LOW": "use a token of the role localize or write",
    "DRAINING": "it stops, and answers only the calls that it has: use another server, or start it again",
}
"""By the reason of an error."""
