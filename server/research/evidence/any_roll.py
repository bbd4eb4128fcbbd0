"""How large the raster must be in which features for any roll of the camera are found."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless_server.engine.photo_views import QueryViews, RasterForm
from mapless_server.engine.query import Photo
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.rolls import similarity_of
from mapless_server.method.features.views import PosedView
from mapless_server.method.options import StageContext
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.promise import PROMISE
from mapless_tools.dataset import Frame
from research.places import Place, Scenes, own_and_other

from .page import Measurement, Row
from .turning import turned, turned_image

PIXELS = (320 * 240, 480 * 360, 640 * 480, 960 * 720, None)
ANGLE_DEG = 45
QUERIES = 2
CONTEXT = StageContext()


@dataclass(frozen=True)
class Found:
    """The second largest agreement of a photograph with references, and the processor time of features and matches."""

    is_own: bool
    max_pixels: int | None
    agreement: float
    seconds: float


def rows(found: Sequence[Found]) -> Iterator[Row]:
    """For each size, the photographs with two references that agree, and the time."""
    for max_pixels in PIXELS:
        own, other = ([it for it in found if it.max_pixels == max_pixels and it.is_own is own] for own in (True, False))
        agreeing = [sum(it.agreement >= PROMISE.agreement for it in some) for some in (own, other)]
        yield {
            "pixels": max_pixels or "all",
            "of the place": f"{agreeing[0]} of {len(own)}",
            "of other places": f"{agreeing[1]} of {len(other)}",
            "processor s, median": f"{np.median([it.seconds for it in (*own, *other)]):.2f}",
        }


def _all_found(scenes: Path) -> Iterator[Found]:
    for _, place, own, others in own_and_other(Scenes(scenes), QUERIES):
        yield from _found(place, [*((it, True) for it in own), *((it, False) for it in others)])


def _found(place: Place, asked: Sequence[tuple[Frame, bool]]) -> Iterator[Found]:
    extractor, matcher = make_extractor("sift"), make_matcher("sift", 1)
    read = ((decode_image(it.image_path.read_bytes(), ImageLimits()), it) for it in place.reference_frames)
    references = [
        PosedView(it.name, it.name, extractor.extract(pixels, it.camera), it.world_from_camera) for pixels, it in read
    ]
    for frame, is_own in asked:
        camera, _ = turned(frame.camera, frame.world_from_camera, ANGLE_DEG)
        photo = Photo(turned_image(frame.image_path, frame.camera, ANGLE_DEG), camera, "image")
        for max_pixels in PIXELS:
            views = QueryViews(photo, ImageLimits()).in_form(RasterForm(max_pixels=max_pixels))
            begin_s = time.process_time()
            view = views.view(extractor, CONTEXT)
            matches = matcher.match_quickly(view, references)
            seconds = time.process_time() - begin_s
            shown = [similarity_of(view, it.view, some) for it, some in zip(references, matches, strict=True)]
            agreement = sorted(it.agreement if it else 0.0 for it in shown)[-2]
            yield Found(is_own, max_pixels, agreement, seconds)
    matcher.close()


MEASUREMENTS = {"any-roll-pixels": Measurement(lambda scenes: rows(list(_all_found(scenes))))}
