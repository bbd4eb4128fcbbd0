"""Converts browsers' calls (gRPC-Web and Connect, by the library connectrpc) to gRPC calls of the server.

Messages are passed on unchanged, with fields that this version does not know; so are deadlines, cancellation, tokens,
and errors with their details. Each call has its caller's own token, never the gateway's. Calls outlive a restart of the
server, except for streams, whose callers begin again.
"""

from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import Any

import grpc
import grpc.aio
from connectrpc.code import Code
from connectrpc.compat import google_protobuf_binary_codec, google_protobuf_json_codec
from connectrpc.errors import ConnectError, ErrorDetail
from connectrpc.method import IdempotencyLevel, MethodInfo, StreamType
from connectrpc.request import RequestContext
from connectrpc.server import ConnectASGIApplication, Endpoint
from google.protobuf.descriptor import MethodDescriptor, ServiceDescriptor
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from google.rpc import status_pb2
from protobuf.wkt import Any as AnyMessage
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from mapless.v1 import localization_service_pb2, reference_service_pb2

from .client import ServerClient
from .guard import Failure, checked_json, public_message

_PASSED_METADATA = ("authorization", "x-client-id", "x-mapless-scene", "x-request-id")
_CONTENT_TYPES = ("application/grpc-web", "application/connect+", "application/proto", "application/json")
_DETAILS = "grpc-status-details-bin"
_CODES = {"CANCELLED": Code.CANCELED}  # spelled differently
_SERVICES: tuple[ServiceDescriptor, ...] = (
    *localization_service_pb2.DESCRIPTOR.services_by_name.values(),
    *reference_service_pb2.DESCRIPTOR.services_by_name.values(),
)
Connect = Callable[[], ServerClient]
_CHANGING = ("Create", "BatchCreate", "Delete")
"""Begin the names of methods that are not repeated if their answer was lost: the caller knows what it has stored."""


class _Application(ConnectASGIApplication[None]):
    path = "/"


class _JsonCodec:
    """The library's codec for texts that are parsed quickly, since the gateway answers no other call meanwhile."""

    def __init__(self) -> None:
        codec = google_protobuf_json_codec()
        self.name, self.encode, self._decode = codec.name, codec.encode, codec.decode

    def decode(self, data: bytes | bytearray, message_class: type[Any]) -> Any:
        return self._decode(checked_json(data), message_class)


def rpc_application(connect: Connect, max_message_bytes: int) -> ASGIApp:
    """Serves the interface's methods at gRPC's paths; `connect` makes the client, once the event loop runs."""
    client: list[ServerClient] = []

    def connected() -> ServerClient:
        if not client:
            client.append(connect())
        return client[0]

    def endpoints(_: None) -> dict[str, Any]:
        return {
            f"/{service.full_name}/{method.name}": _endpoint(connected, service, method)
            for service in _SERVICES
            for method in service.methods
        }

    application = _Application(
        service=None,
        endpoints=endpoints,
        read_max_bytes=max_message_bytes,
        compressions=(),  # photographs are compressed, and all else is small
        codecs=(google_protobuf_binary_codec(), _JsonCodec()),
    )

    async def serve(scope: Scope, receive: Receive, send: Send) -> None:
        headers = Headers(scope=scope)
        wrong = None
        if scope["method"] != "POST":
            wrong = Failure("calls are sent by POST", 405, reason="METHOD_NOT_ALLOWED")
        elif not headers.get("content-type", "").startswith(_CONTENT_TYPES):
            wrong = Failure(f"must be one of {', '.join(_CONTENT_TYPES)}", 415, field="content-type")
        if wrong is not None:
            await wrong.response()(scope, receive, send)
            return
        readable = [pair for pair in scope["headers"] if all(map(_is_printable, pair))]
        passed: Any = {**scope, "headers": readable}
        with suppress(Failure):  # of what is received: has been answered
            await application(passed, receive, send)

    return serve


def _is_printable(text: bytes) -> bool:
    return text.isascii() and text.decode("ascii").isprintable()


def _endpoint(connected: Connect, service: ServiceDescriptor, method: MethodDescriptor) -> Any:
    request_type, response_type = GetMessageClass(method.input_type), GetMessageClass(method.output_type)
    path = f"/{service.full_name}/{method.name}"

    def begin(
        make: Callable[..., Any], request: Any, context: RequestContext[Any, Any], timeout_s: float | None
    ) -> Any:
        call = make(
            path, request_serializer=request_type.SerializeToString, response_deserializer=response_type.FromString
        )
        given = context.request_headers
        metadata = tuple((name, given[name]) for name in _PASSED_METADATA if name in given)
        return call(request, timeout=timeout_s, metadata=metadata)

    async def unary(request: Any, context: RequestContext[Any, Any]) -> Any:
        can_repeat = not method.name.startswith(_CHANGING)
        try:
            return await connected().passed(
                method.name,
                lambda channel, left_s: begin(channel.unary_unary, request, context, left_s),
                _timeout_s(context),
                can_repeat=can_repeat,
            )
        except grpc.aio.AioRpcError as error:
            raise _error(error, context) from None

    async def stream(request: Any, context: RequestContext[Any, Any]) -> AsyncIterator[Any]:
        call = begin(connected().channel().unary_stream, request, context, _timeout_s(context))
        try:
            async for message in call:
                yield message
        except grpc.aio.AioRpcError as error:
            raise _error(error, context) from None
        finally:
            call.cancel()

    info = MethodInfo(
        name=method.name,
        service_name=service.full_name,
        input=request_type,
        output=response_type,
        idempotency_level=IdempotencyLevel.UNKNOWN,
        stream_type=StreamType.SERVER_STREAM if method.server_streaming else StreamType.UNARY,
    )
    return Endpoint.server_stream(info, stream) if method.server_streaming else Endpoint.unary(info, unary)


def _timeout_s(context: RequestContext[Any, Any]) -> float | None:
    """The caller's deadline; None for the server's default."""
    return None if context.timeout_ms is None else max(context.timeout_ms, 1) / 1000


def _error(error: grpc.aio.AioRpcError, context: RequestContext[Any, Any]) -> ConnectError:
    metadata = dict(error.trailing_metadata() or ())
    if request_id := str(metadata.get("x-request-id", "")):
        context.response_trailers["x-request-id"] = request_id
    try:
        status = status_pb2.Status.FromString(metadata.get(_DETAILS, b""))
    except DecodeError:  # of a proxy in between
        status = status_pb2.Status()
    details = [ErrorDetail(AnyMessage(type_url=it.type_url, value=it.value)) for it in status.details]
    name = error.code().name
    message = public_message(name, error.details() or "", request_id)
    return ConnectError(_CODES.get(name) or Code(name.lower()), message, details)
