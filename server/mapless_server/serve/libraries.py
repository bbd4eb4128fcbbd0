"""What libraries must know before they are imported and before there are threads; commands set it first."""

from __future__ import annotations

import ctypes
import os
import sys

from mapless_server.settings import Settings

_MALLOC_OPTIONS = {-8: 1, -3: 32 * 2**20, -1: 128 * 2**20}
"""M_ARENA_MAX, M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of glibc's malloc.h."""


def configure_libraries(settings: Settings) -> None:
    """Sets environment variables that libraries read, and how memory is allocated; the operator's own values stay."""
    environment = {
        # Calls run in parallel, and matching has threads of its own. The matrices are small, and threads of BLAS wait
        # for one another in a busy loop: with two, on two cores of which one was busy, a call took 1.9 s instead of
        # 0.4.
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        # In addition to our own check of image headers.
        "OPENCV_IO_MAX_IMAGE_PIXELS": str(round(settings.max_image_megapixels * 1_000_000)),
        # Errors of files and addresses are reported by mapless.
        "OPENCV_LOG_LEVEL": "SILENT",
        "GRPC_VERBOSITY": "NONE",
    }
    for name, value in environment.items():
        os.environ.setdefault(name, value)
    if "GLIBC_TUNABLES" not in os.environ and not any(name.startswith("MALLOC_") for name in os.environ):
        _share_one_heap()


def _share_one_heap() -> None:
    """Lets all threads allocate from the same heap, where the C library is glibc.

    It gives threads heaps of their own, each of which keeps the tens of megabytes that the features of one photograph
    need for a moment: a server without references had 415 MiB instead of 225. Threads hold Python's lock for most
    allocations, so that they do not wait for the heap. It keeps up to 128 MiB free for the next query, because
    requesting them from the system took a query 16 ms.
    """
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        for option, value in _MALLOC_OPTIONS.items():
            mallopt(option, value)
