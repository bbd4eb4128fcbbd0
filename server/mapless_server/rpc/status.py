"""Errors in the form that callers receive: google.rpc.Status with details for programs."""

import grpc
from google.protobuf.message import Message
from google.rpc import error_details_pb2, status_pb2

from mapless_server.errors import AlreadyExists, NotFound, RequestError

_DOMAIN = "mapless"
_MAX_MESSAGE_CHARACTERS = 1000  # trailers hold about 8 KB, and they hold the text twice


def to_status(error: RequestError, request_id: str = "") -> status_pb2.Status:
    """Converts an error to google.rpc.Status: one ErrorInfo, the details of its kind, and the request id if given."""
    message = str(error)[:_MAX_MESSAGE_CHARACTERS]
    field = {} if error.field is None else {"field": error.field}
    details: list[Message] = [error_details_pb2.ErrorInfo(reason=error.reason, domain=_DOMAIN, metadata=field)]
    if isinstance(error, NotFound | AlreadyExists):
        kind = "Reference" if "/references/" in error.resource else "Scene"
        resource = {"resource_type": f"mapless.v1.{kind}", "resource_name": error.resource} if error.resource else {}
        details.append(error_details_pb2.ResourceInfo(**resource, description=message))
    elif error.field is not None:
        violation = error_details_pb2.BadRequest.FieldViolation(field=error.field, description=message)
        details.append(error_details_pb2.BadRequest(field_violations=[violation]))
    if error.retry_after_s is not None:
        retry = error_details_pb2.RetryInfo()
        retry.retry_delay.FromMilliseconds(round(1000 * error.retry_after_s))
        details.append(retry)
    if request_id:
        details.append(error_details_pb2.RequestInfo(request_id=request_id))
    status = status_pb2.Status(code=grpc.StatusCode[error.code].value[0], message=message)
    for detail in details:
        status.details.add().Pack(detail)
    return status
