"""Errors of the gateway: an HTTP status, and JSON that says what is wrong, in which field."""

import math

from starlette.responses import JSONResponse

from mapless import MaplessError

_STATUS = {
    "INVALID_ARGUMENT": 400,
    "UNAUTHENTICATED": 401,
    "PERMISSION_DENIED": 403,
    "NOT_FOUND": 404,
    "ALREADY_EXISTS": 409,
    "FAILED_PRECONDITION": 409,
    "RESOURCE_EXHAUSTED": 429,
    "UNAVAILABLE": 503,
    "DEADLINE_EXCEEDED": 504,
}
"""By the name of a gRPC status; all others are 502, faults of the server behind the gateway."""


class Failure(Exception):
    """A request that is not answered: an HTTP status, and the members of `error` in the JSON.

    Members without a value are left out; the message begins with the field. `retry_after_s` is None if another attempt
    would not help.
    """

    def __init__(
        self,
        message: str,
        status: int = 400,
        *,
        reason: str = "INVALID_ARGUMENT",
        field: str | None = None,
        retry_after_s: float | None = None,
        **more: str | None,
    ) -> None:
        message = f"{field}: {message}" if field and field not in message else message
        super().__init__(message)
        self.status = status
        self.content = {"reason": reason, "message": message, "field": field or None} | more
        self.retry_after_s = retry_after_s

    def response(self) -> JSONResponse:
        """The HTTP response."""
        after = {} if self.retry_after_s is None else {"retry-after": str(math.ceil(self.retry_after_s))}
        content = {name: value for name, value in self.content.items() if value is not None}
        return JSONResponse({"error": content}, self.status, after)


def of_server(error: MaplessError, field: str | None = None) -> Failure:
    """Makes the failure of a call; `field` replaces the error's own."""
    return Failure(
        error.message,
        _STATUS.get(error.code, 502),
        reason=error.reason,
        field=field or error.field,
        retry_after_s=error.retry_after_s,
        request_id=error.request_id or None,
    )
