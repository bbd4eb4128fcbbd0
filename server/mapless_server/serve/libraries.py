"""What libraries read from the environment when they are imported; a command sets it before it imports them."""

from __future__ import annotations

import os

from mapless_server.settings import Settings


def configure_libraries(settings: Settings) -> None:
    """Sets what libraries read from the environment once, when they are imported; what is set already stays."""
    environment = {
        # Calls run side by side, and matching shares out its own work. The matrices are small, and BLAS threads wait
        # for one another in a busy loop: with two, on two cores of which one was taken, a call took 1.9 s, not 0.4.
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        # Stands behind our own reading of headers.
        "OPENCV_IO_MAX_IMAGE_PIXELS": str(round(settings.max_image_megapixels * 1_000_000)),
        # What is wrong with a file or an address, we say ourselves.
        "OPENCV_LOG_LEVEL": "SILENT",
        "GRPC_VERBOSITY": "NONE",
    }
    for name, value in environment.items():
        os.environ.setdefault(name, value)
