"""A server that computes nothing, as a program, which shows what serving itself costs.

Everything is real, from the sockets to the store, the queue and its threads; only the extractor finds no features, and
the method's three stages only pass the query on. `padded_photo` makes an image with the bytes of a photograph but few
pixels, so that decoding it costs nothing either.
"""

import asyncio
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.engine.query import Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.engine.stages import Method
from mapless_server.method.features.views import Features, Ignored, View
from mapless_server.method.judge.answer import Answer
from mapless_server.method.judge.hypothesis import Doubt, Failed
from mapless_server.method.pipeline import Coarse, Pipeline, Prepared
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.observability.logs import configure_logging
from mapless_server.observability.metrics import Metrics
from mapless_server.security import RateLimiter
from mapless_server.serve.assembly import Parts, engine_options, engine_over
from mapless_server.serve.libraries import configure_libraries
from mapless_server.serve.run import serve
from mapless_server.settings import Settings, load_settings
from mapless_server.store import Store

SIDE_PX = 64
CAMERA = Camera(SIDE_PX, SIDE_PX, 60.0, 60.0, 31.5, 31.5)
_MAX_COMMENT_BYTES = 65_000  # a JPEG's segment has room for 65,533


class BlindExtractor:
    """Finds no features in any photograph."""

    name = "blind"

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """A view without features."""
        nothing = Features(np.zeros((0, 2), np.float32), np.zeros((0, 4), np.float32), np.zeros(0, np.float32))
        return View(camera.pinhole(), nothing)


def padded_photo(size_bytes: int) -> bytes:
    """A grey JPEG of 64 by 64 pixels with comments, about `size_bytes` long."""
    jpeg = bytes(cv2.imencode(".jpg", np.full((SIDE_PX, SIDE_PX), 128, np.uint8))[1])
    start_of_image, rest = jpeg[:2], jpeg[2:]
    missing = max(0, size_bytes - len(jpeg))
    lengths = [_MAX_COMMENT_BYTES] * (missing // _MAX_COMMENT_BYTES) + [missing % _MAX_COMMENT_BYTES]
    comments = b"".join(b"\xff\xfe" + (length + 2).to_bytes(2, "big") + bytes(length) for length in lengths)
    return start_of_image + comments + rest


def no_op_method() -> Method:
    """A method that goes through all stages, and rejects every photograph."""
    rejected = Answer(Rejection(RejectionReason.LOW_TEXTURE, "nothing was computed"))
    return Method(
        prepare=lambda *_: cast(Prepared, SimpleNamespace(bucket="nothing")),  # all queries are of one bucket
        reconstruct=lambda batch: [cast(Coarse, part) for part in batch],
        solve=lambda _, attempt, __: Failed(attempt, rejected, Doubt.NONE),
        coarse_answer=lambda _: None,
    )


def make_no_op_engine(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
    """An engine with the settings' queue and threads that computes nothing."""
    tiers = [Tier(BlindExtractor(), Pipeline())]
    engine = engine_over(store, tiers, engine_options(settings), Parts(metrics, quota, no_op_method()))
    # Callers whose photographs are all rejected would wait for others, in threads of low priority.
    engine.queue.answered = lambda *_: None  # type: ignore[method-assign]
    return engine


def main(data_dir: Path | None) -> None:
    """Serves until SIGTERM with a store in the folder, or the environment's; logs as much as a server by default."""
    settings = load_settings({"port": 0, "metrics_port": 0, "warm_up": False, "data_dir": data_dir}).settings
    configure_libraries(settings)
    with open(os.devnull if data_dir is None else data_dir / "log", "w", encoding="utf-8") as stream:
        configure_logging(settings, stream)
        asyncio.run(serve(settings, make_no_op_engine))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else None)
