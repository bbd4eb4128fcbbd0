"""Settings that libraries need before they are imported and threads are started; commands make them first."""

import ctypes
import os
import sys

from mapless_server.settings import Settings

_MALLOC_OPTIONS = {-8: 1, -3: 32 * 2**20, -1: 192 * 2**20}
"""M_ARENA_MAX, M_MMAP_THRESHOLD and M_TRIM_THRESHOLD of glibc's malloc.h."""


def configure_libraries(settings: Settings) -> None:
    """Sets environment variables of libraries, and the allocation of memory; the operator's own values remain."""
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


def trim_heap() -> None:
    """Gives the heap's free memory back to the system, if the C library is glibc: the next query requests it again."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)


def _share_one_heap() -> None:
    """Makes all threads allocate from the same heap, if the C library is glibc.

    By default glibc gives each thread its own heap, which keeps the tens of megabytes that the features of one
    photograph need for a short time: a server without references had 415 MiB instead of 225. Threads have Python's
    lock for most allocations, so they do not wait for the heap. The heap keeps up to 192 MiB free for the next
    query, because requesting them from the system took 16 ms per query, and 38 ms with SIFT at 1024x768, whose pyramid
    needs 160 MiB.
    """
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        for option, value in _MALLOC_OPTIONS.items():
            mallopt(option, value)
