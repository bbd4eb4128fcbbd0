"""What an exception of a computation means for the work queue. Knows torch's by name: the server may be without it."""

from __future__ import annotations

import re

from mapless_server.errors import (
    AlreadyExists,
    FailedPrecondition,
    InvalidArgument,
    NotFound,
    PermissionDenied,
    Unauthenticated,
)
from mapless_server.scheduling import Failure

_CALLERS = (InvalidArgument, Unauthenticated, PermissionDenied, NotFound, AlreadyExists, FailedPrecondition)
"""What the caller has to mend. The other errors of requests are told to callers, too, but are the server's."""

_LOST = re.compile(r"CUDA error|CUBLAS_STATUS_(?!ALLOC_FAILED)|CUDNN_STATUS_(?!ALLOC_FAILED)|device-side assert")
"""After any of these every later call fails too, or worse, gives garbage: the context is poisoned."""

_FULL = re.compile(r"CUDA out of memory|_STATUS_ALLOC_FAILED|CUDA error: out of memory|DefaultCPUAllocator")


def failure_of(error: BaseException) -> Failure:
    """Whose fault it is, and what is left."""
    if isinstance(error, _CALLERS):
        return Failure.BAD_INPUT
    names = {kind.__name__ for kind in type(error).__mro__}
    if "OutOfMemoryError" in names or isinstance(error, MemoryError):
        return Failure.OUT_OF_MEMORY
    if isinstance(error, RuntimeError):
        message = str(error)
        if _FULL.search(message):
            return Failure.OUT_OF_MEMORY
        if "AcceleratorError" in names or _LOST.search(message):
            return Failure.DEVICE_LOST
    return Failure.JOB_FAILED
