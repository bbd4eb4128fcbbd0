"""Errors of calls. A photograph that could not be localized is not an error but an answer, `Rejected`."""

import re
from typing import Any, TypeVar
from urllib.parse import unquote

from google.protobuf.message import DecodeError, Message
from google.rpc import error_details_pb2, status_pb2

_DETAILS_KEY = "grpc-status-details-bin"
_NO_TIME = "Deadline Exceeded"
_NOT_CONNECTED = ("connections to all backends failing", "failed to connect to all addresses")
_UNRESOLVED = re.compile(r"(?:errors resolving|DNS resolution failed for) (\S+?):? .*", re.DOTALL)
REFUSED = "no server listens there"
USES_TLS = "the server uses TLS; give --tls or --ca FILE (Python: tls, root_certificates)"
_MISCONFIGURED = {
    "Failed to create security handshaker": "the given certificates are unusable; they must be PEM",
    "missing selected ALPN property": "the server, or what ends TLS in front of it, does not offer HTTP/2 (ALPN h2), "
    "which gRPC requires; let nginx, HAProxy or the load balancer offer h2 at that port",
    "WRONG_VERSION_NUMBER": "the server does not use TLS",
    "Expected SETTINGS frame": "what answers there does not speak gRPC (HTTP/2); it may be the port of the metrics",
    "certificate has expired": "the server's certificate has expired, or the clock of this machine is fast",
    "certificate is not yet valid": "the server's certificate is not valid yet, or the clock of this machine is slow",
    "Hostname Verification Check failed": "the server's certificate is for another name",
    "unable to get local issuer certificate": "the server's certificate is not signed by a known authority; give its "
    "certificate with --ca FILE (Python: root_certificates)",
    "self signed certificate": "the server's certificate is self-signed; give it with --ca FILE (Python: "
    "root_certificates)",
    "HTTP proxy returned response code 407": "the proxy requires a user and a password: http://user:password@host:port",
}
"""Failures that another attempt does not change, by a sign in gRPC's text."""
_NOT_CONNECTED_BECAUSE = _MISCONFIGURED | {
    "HTTP proxy returned response code": "the proxy refuses or does not reach the server",
    "Socket closed": "the server closes the connection at once: all of its connections are taken, or it uses TLS "
    "(give --tls or --ca FILE; Python: tls, root_certificates), or requires a client certificate (--cert)",
    "Connection refused": f"{REFUSED} (connection refused)",
    "timed out before receiving SETTINGS frame": "a connection is accepted, but nothing answers in time",
}
_BROKEN = re.compile(
    r"RST_STREAM with error code [02]\b|Stream removed|Connection reset|Broken pipe|Socket closed|Transport closed|"
    r"GOAWAY|http2 header with status: 50\d"
)
"""In the text of a status INTERNAL or UNKNOWN that gRPC made of a connection that broke, or of a proxy's answer."""
_ADDRESS = re.compile(r"ipv[46]:(\S+): ")
Detail = TypeVar("Detail", bound=Message)


class MaplessError(Exception):
    """Base of all errors of calls.

    Attributes:
        code: name of the gRPC status, "INVALID_ARGUMENT".
        reason: UPPER_SNAKE_CASE, stable, for programs; the code where the server gave no reason.
        message: one sentence for a person.
        field: path of the wrong field in the request, "intrinsics.focal_x_px", or None.
        retry_after_s: seconds after which the server requests a retry, or None.
        request_id: identifies the call in the server's log; empty if the call did not reach it.
        resource: the scene or reference that does not exist or exists already, "scenes/{scene}"; else empty.
        address: the server's, as it was given; of several, that of the last attempt; empty for errors of no attempt.
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
        resource: str = "",
    ) -> None:
        named = f" (field {field})" if field and field not in message else ""
        super().__init__(f"{reason or code}: {message}{named}")
        self.code = code
        self.reason = reason or code
        self.message = message
        self.field = field
        self.retry_after_s = retry_after_s
        self.request_id = request_id
        self.resource = resource
        self.address = ""


class InvalidArgument(MaplessError):
    """The request is wrong: a bad image, camera, pose, name or field."""


class Unauthenticated(MaplessError):
    """The server requires a token, and it is missing, wrong or expired."""


class PermissionDenied(MaplessError):
    """The token's role does not include the call."""


class NotFound(MaplessError):
    """The scene or the reference does not exist."""


class AlreadyExists(MaplessError):
    """The id is taken."""


class FailedPrecondition(MaplessError):
    """The server's configuration or state does not permit the call."""


class ResourceExhausted(MaplessError):
    """Too many calls wait (`retry_after_s` is set), or the message is larger than the server's limit."""


class DeadlineExceeded(MaplessError):
    """No answer arrived before the deadline."""


class Unavailable(MaplessError):
    """The server cannot be reached, starts, drains, or went away during the answer; all retries failed.

    Also the error of a connection that breaks during the answer, which gRPC may call INTERNAL, UNKNOWN or CANCELLED.
    """


class DataLoss(MaplessError):
    """A stored reference is damaged."""


class Internal(MaplessError):
    """A fault of the server; its log has the details under `request_id`.

    The client itself raises it, with the reason MALFORMED_ANSWER, for an answer that violates the interface.
    """


_BY_CODE: dict[str, type[MaplessError]] = {
    re.sub("(?<=.)(?=[A-Z])", "_", kind.__name__).upper(): kind for kind in MaplessError.__subclasses__()
} | {"CANCELLED": Unavailable}
"""Error classes by the name of their gRPC status: InvalidArgument by INVALID_ARGUMENT. A call that its caller did not
cancel is CANCELLED where the server, or one behind a load balancer, goes away during the answer."""


def from_rpc_error(error: Any) -> MaplessError:
    """The MaplessError of a grpc.RpcError, which is its cause."""
    metadata = dict(error.trailing_metadata() or ())
    try:
        status = status_pb2.Status.FromString(metadata.get(_DETAILS_KEY, b""))
    except DecodeError:  # details in a proxy's own format; the plain status remains
        status = status_pb2.Status()
    info = _detail(status, error_details_pb2.ErrorInfo())
    retry = _detail(status, error_details_pb2.RetryInfo())
    request = _detail(status, error_details_pb2.RequestInfo())
    resource = _detail(status, error_details_pb2.ResourceInfo())
    code, details = error.code().name, error.details() or ""
    if code in ("INTERNAL", "UNKNOWN") and "x-request-id" not in metadata and _BROKEN.search(details):
        code, details = "UNAVAILABLE", f"the connection broke before the answer: {details}"
    failure = _BY_CODE.get(code, MaplessError)(
        code,
        _message(details),
        reason=info.reason if info else "",
        field=(info.metadata.get("field") if info else None),
        retry_after_s=retry.retry_delay.ToNanoseconds() / 1e9 if retry else None,
        request_id=metadata.get("x-request-id", "") or (request.request_id if request else ""),
        resource=resource.resource_name if resource else "",
    )
    failure.__cause__ = error
    return failure


def is_unconnected(error: MaplessError) -> bool:
    """Whether no connection could be made, so that the call has reached no server."""
    return error.code == "UNAVAILABLE" and error.message.startswith("cannot connect")


def is_misconfigured(error: MaplessError) -> bool:
    """Whether no connection could be made for a reason that another attempt does not change, such as a certificate."""
    return is_unconnected(error) and any(it in error.message for it in (USES_TLS, *_MISCONFIGURED.values()))


def _message(details: str) -> str:
    """The message of an error: why a connection failed, in plain words where the cause is known, else gRPC's text."""
    if details == _NO_TIME:
        return "no answer in time"
    if unresolved := _UNRESOLVED.fullmatch(details):
        return f"cannot connect to {unresolved[1]}: the name cannot be resolved"
    if not details.startswith(_NOT_CONNECTED):
        return details
    reason = details.rpartition("last error: ")[2]
    known = next((words for sign, words in _NOT_CONNECTED_BECAUSE.items() if sign in reason), "")
    if status := re.search(r"HTTP proxy returned response code (\d+)", reason):
        known += f" (HTTP {status[1]})"
    address = _ADDRESS.search(reason)
    where = unquote(address[1]) if address else ""
    if where.endswith(":443") and "Connection refused" in reason:
        known += "; an address without a port has port 443"
    return f"cannot connect{f' to {where}' if where else ''}: {known or reason}"


def _detail(status: status_pb2.Status, empty: Detail) -> Detail | None:
    """The status's detail of the type of `empty`, unpacked into it; None if there is none."""
    return next((empty for packed in status.details if packed.Unpack(empty)), None)
