"""Errors of requests: exceptions with a status, a reason and a text for the caller.

This module does not import grpc: `code` is the name of a gRPC status, which only `rpc` converts. Every other exception
    is a fault of the server: the caller gets only INTERNAL, and the log has the details.
"""


class RequestError(Exception):
    """Base of all errors of requests; by itself, a fault of the server.

    Attributes:
        code: name of the gRPC status.
        reason: UPPER_SNAKE_CASE, stable, for programs; the class's `default_reason`, or the code, if none is given.
        field: path of the wrong field in the request, "intrinsics.focal_x_px", or None.
        retry_after_s: seconds until another attempt, or None if a retry would not help.
        resource: name of the scene or reference that does not exist or exists already; else empty.
    """

    code = "INTERNAL"
    default_reason = ""

    def __init__(
        self,
        message: str,
        *,
        reason: str = "",
        field: str | None = None,
        retry_after_s: float | None = None,
        resource: str = "",
    ) -> None:
        super().__init__(message)
        self.reason = reason or self.default_reason or self.code
        self.field = field
        self.retry_after_s = retry_after_s
        self.resource = resource


class InvalidArgument(RequestError):
    """The request itself is wrong: a bad image, camera, pose, name or field."""

    code = "INVALID_ARGUMENT"


class Unauthenticated(RequestError):
    """The caller is unknown: the token is missing, unknown or expired."""

    code = "UNAUTHENTICATED"


class PermissionDenied(RequestError):
    """The caller is known, and its role, or the scenes that its token is for, do not allow this."""

    code = "PERMISSION_DENIED"


class NotFound(RequestError):
    """A well-formed name of something that does not exist."""

    code = "NOT_FOUND"


class FailedPrecondition(RequestError):
    """The server is not configured for this; the same request succeeds once it is."""

    code = "FAILED_PRECONDITION"


class AlreadyExists(RequestError):
    """The id is taken."""

    code = "ALREADY_EXISTS"


class Overloaded(RequestError):
    """Too many calls wait already; carries `retry_after_s`."""

    code = "RESOURCE_EXHAUSTED"
    default_reason = "OVERLOADED"


class DeadlineExceeded(RequestError):
    """The caller's deadline passed, or cannot be met, before the work began."""

    code = "DEADLINE_EXCEEDED"


class Unavailable(RequestError):
    """The server drains, or the scene changes during the call; an attempt elsewhere or later succeeds."""

    code = "UNAVAILABLE"


class DataLoss(RequestError):
    """Stored bytes are damaged."""

    code = "DATA_LOSS"


class NetworkNotLoaded(RuntimeError):
    """A network cannot be loaded; no error of a request, but a fault of the server that lasts.

    Attributes:
        retry_after_s: seconds until loading is tried again; before, it fails at once.
    """

    def __init__(self, message: str, retry_after_s: float) -> None:
        super().__init__(message)
        self.retry_after_s = retry_after_s
