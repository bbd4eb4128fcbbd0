"""What can be wrong with a request: exceptions that carry their status and a text fit for the caller.

Nothing here knows grpc: `code` is the name of a gRPC status, and the service alone turns it into one. Everything that
is not one of these is a fault of ours: the caller is told INTERNAL and nothing else, the log has the rest.
"""

from __future__ import annotations


class RequestError(Exception):
    """Base of all answers that are errors.

    Attributes:
        code: name of the gRPC status.
        reason: UPPER_SNAKE_CASE, stable, for programs.
        field: path of the guilty field in the request, "intrinsics.focal_x_px", or None.
        retry_after_s: when to try again, seconds, or None if a retry would change nothing.
    """

    code = "INTERNAL"
    reason = "INTERNAL"

    def __init__(
        self, message: str, *, reason: str | None = None, field: str | None = None, retry_after_s: float | None = None
    ) -> None:
        super().__init__(message)
        self.reason = reason or type(self).reason
        self.field = field
        self.retry_after_s = retry_after_s


class InvalidArgument(RequestError):
    """The request itself is wrong: a bad image, camera, pose, name or field."""

    code = "INVALID_ARGUMENT"
    reason = "INVALID_ARGUMENT"


class Unauthenticated(RequestError):
    """Nobody knows who calls: the token is missing, unknown or expired."""

    code = "UNAUTHENTICATED"
    reason = "UNAUTHENTICATED"


class PermissionDenied(RequestError):
    """It is known who calls, and that they may not do this."""

    code = "PERMISSION_DENIED"
    reason = "PERMISSION_DENIED"


class NotFound(RequestError):
    """A well-formed name of something that does not exist."""

    code = "NOT_FOUND"
    reason = "NOT_FOUND"


class FailedPrecondition(RequestError):
    """The server is not configured for this; the same request succeeds once it is."""

    code = "FAILED_PRECONDITION"
    reason = "FAILED_PRECONDITION"


class AlreadyExists(RequestError):
    """The id is taken."""

    code = "ALREADY_EXISTS"
    reason = "ALREADY_EXISTS"


class Overloaded(RequestError):
    """Too many calls wait already; carries `retry_after_s`."""

    code = "RESOURCE_EXHAUSTED"
    reason = "OVERLOADED"


class DeadlineExceeded(RequestError):
    """The caller's deadline passed, or cannot be met, before the work began."""

    code = "DEADLINE_EXCEEDED"
    reason = "DEADLINE_EXCEEDED"


class Unavailable(RequestError):
    """The server drains, or the scene changes under the call; another try elsewhere or later succeeds."""

    code = "UNAVAILABLE"
    reason = "UNAVAILABLE"


class DataLoss(RequestError):
    """Stored bytes are not what was stored."""

    code = "DATA_LOSS"
    reason = "DATA_LOSS"
