"""Classifies exceptions of a computation for the work queue. Knows torch's by name, since it need not be installed."""

import re

from mapless_server.errors import (
    AlreadyExists,
    FailedPrecondition,
    InvalidArgument,
    NotFound,
    PermissionDenied,
    Unauthenticated,
    Unavailable,
)
from mapless_server.scheduling import Failure


class SceneMadeAnew(Unavailable):
    """The scene was deleted and created again during the call, or its poses mean something else since."""

    def __init__(self) -> None:
        super().__init__("the scene was changed during the call", reason="SCENE_CHANGED", retry_after_s=1.0)


_CALLERS = (InvalidArgument, Unauthenticated, PermissionDenied, NotFound, AlreadyExists, FailedPrecondition)
"""The caller's mistakes. Other errors of requests are sent to callers, too, but are the server's."""

_LOST = re.compile(r"CUDA error|CUBLAS_STATUS_(?!ALLOC_FAILED)|CUDNN_STATUS_(?!ALLOC_FAILED)|device-side assert")
"""After any of these every later call fails, too, or returns wrong numbers: the CUDA context is lost."""

_FULL = re.compile(r"CUDA out of memory|_STATUS_ALLOC_FAILED|CUDA error: out of memory|DefaultCPUAllocator")


def failure_of(error: BaseException) -> Failure:
    """Returns what failed: the input, this job, memory, or the device."""
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
