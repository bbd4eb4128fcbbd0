"""Environment variables that libraries read when they are imported; commands set them before that."""

from __future__ import annotations

import os

from mapless_server.settings import Settings


def configure_libraries(settings: Settings) -> None:
    """Sets the variables; the operator's own values stay."""
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
