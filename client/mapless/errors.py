"""What a call can fail with. A photograph that was not localized is not among them: it is an answer, `Rejected`."""

from __future__ import annotations

import re
from typing import Any, TypeVar

import grpc
from google.protobuf.message import DecodeError, Message
from google.rpc import error_details_pb2, status_pb2

_DETAILS_KEY = "grpc-status-details-bin"
_NO_TIME = "Deadline Exceeded"
_NOT_CONNECTED = "connections to all backends failing"
_NOT_CONNECTED_BECAUSE = {
    "Socket closed": "the server hangs up at once; does it speak TLS? Then say so, --tls or --ca FILE (Python: tls, "
    "root_certificates), and --cert if it asks for a certificate",
    "WRONG_VERSION_NUMBER": "the server does not speak TLS",
    "unable to get local issuer certificate": "the server's certificate is not signed by a known one; --ca FILE "
    "(Python: root_certificates) names another",
    "Failed to create security handshaker": "what was given as certificates is unusable; is it PEM?",
    "Connection refused": "nobody listens there (connection refused)",
}
_ADDRESS = re.compile(r"ipv[46]:(\S+): ")
Detail = TypeVar("Detail", bound=Message)


class MaplessError(Exception):
    """Base of all errors of calls.

    Attributes:
        code: name of the gRPC status, "INVALID_ARGUMENT".
        reason: UPPER_SNAKE_CASE, stable, for programs; the code again where the server gave none.
        message: one sentence for a person.
        field: path of the guilty field in the request, "intrinsics.focal_x_px", or None.
        retry_after_s: when the server asks to be tried again, seconds, or None.
        request_id: identifies the call in the server's log; empty if the call did not reach it.
    """

    def __init__(
        self,
        code: str,
        message: str,
        *,
        reason: str = "",
        field: str | None = None,
        retry_after_s: float | None = None,
        request_id: str = "",
    ) -> None:
        super().__init__(f"{reason or code}: {message}")
        self.code = code
        self.reason = reason or code
        self.message = message
        self.field = field
        self.retry_after_s = retry_after_s
        self.request_id = request_id


class InvalidArgument(MaplessError):
    """The request is wrong: a bad image, camera, pose, name or field."""


class Unauthenticated(MaplessError):
    """The server asks for a token, and none was shown, or one that is wrong or has expired."""


class PermissionDenied(MaplessError):
    """The token does not allow this."""


class NotFound(MaplessError):
    """There is no such scene or reference."""


class AlreadyExists(MaplessError):
    """The id is taken."""


class FailedPrecondition(MaplessError):
    """The server is not set up for this."""


class ResourceExhausted(MaplessError):
    """Too many calls wait (`retry_after_s` says when to come back), or the message is larger than the limit."""


class DeadlineExceeded(MaplessError):
    """No answer in time."""


class Unavailable(MaplessError):
    """The server cannot be reached, starts or drains; retries did not help."""


class DataLoss(MaplessError):
    """A stored reference is damaged."""


class Internal(MaplessError):
    """A fault of the server; its log has the rest under `request_id`.

    The reason MALFORMED_ANSWER is the client's: what the server sent breaks the contract.
    """


_BY_CODE: dict[str, type[MaplessError]] = {
    "INVALID_ARGUMENT": InvalidArgument,
    "UNAUTHENTICATED": Unauthenticated,
    "PERMISSION_DENIED": PermissionDenied,
    "NOT_FOUND": NotFound,
    "ALREADY_EXISTS": AlreadyExists,
    "FAILED_PRECONDITION": FailedPrecondition,
    "RESOURCE_EXHAUSTED": ResourceExhausted,
    "DEADLINE_EXCEEDED": DeadlineExceeded,
    "UNAVAILABLE": Unavailable,
    "DATA_LOSS": DataLoss,
    "INTERNAL": Internal,
}


def from_rpc_error(error: Any) -> MaplessError:
    """Our error of a grpc.RpcError that a blocking call raised."""
    metadata = dict(error.trailing_metadata() or ())
    try:
        status = status_pb2.Status.FromString(metadata.get(_DETAILS_KEY, b""))
    except DecodeError:  # some proxy's own; the plain status remains
        status = status_pb2.Status()
    info = _detail(status, error_details_pb2.ErrorInfo())
    retry = _detail(status, error_details_pb2.RetryInfo())
    code: grpc.StatusCode = error.code()
    return _BY_CODE.get(code.name, MaplessError)(
        code.name,
        _in_words(error.details() or ""),
        reason=info.reason if info else "",
        field=(info.metadata.get("field") if info else None),
        retry_after_s=retry.retry_delay.ToNanoseconds() / 1e9 if retry else None,
        request_id=metadata.get("x-request-id", ""),
    )


def _in_words(details: str) -> str:
    """What kept a connection from being made, in other words than gRPC's where it is known; else as it is said."""
    if details == _NO_TIME:
        return "no answer in time"
    if not details.startswith(_NOT_CONNECTED):
        return details
    reason = details.rpartition("last error: ")[2]
    known = next((words for sign, words in _NOT_CONNECTED_BECAUSE.items() if sign in reason), "")
    address = _ADDRESS.search(reason)
    return f"cannot connect{f' to {address[1]}' if address else ''}: {known or reason}"


def _detail(status: status_pb2.Status, empty: Detail) -> Detail | None:
    """The status's detail of the type of `empty`, which is filled, or None."""
    return next((empty for packed in status.details if packed.Unpack(empty)), None)
