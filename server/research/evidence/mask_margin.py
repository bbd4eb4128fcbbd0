"""How far keypoints must be from the ignored pixels of a mask that is exact."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from unittest.mock import patch

import numpy as np

from mapless.geometry import Camera
from mapless_server.method.features import masks
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.views import PosedView, View
from mapless_server.method.pairs.stationary import StationaryOptions

from .overlays import OVERLAYS, Image, clutter
from .page import Measurement, Row
from .stationary import Posed, encoded, localized, pipeline_of, scene_of_room

MARGINS_PX = (None, 0.0, 2.0, 4.0, 8.0)
"""None: without masks."""
OTHERS = 8


def _rows(folder: Path) -> Iterator[Row]:
    room = scene_of_room()
    camera = room.references[0].camera
    others = [clutter((camera.height_px, camera.width_px, 3), 100 + i) for i in range(OTHERS)]
    for margin_px in MARGINS_PX:
        with patch.object(masks, "MARGIN_PX", margin_px or 0.0):
            references = [_posed(it, margin_px) for it in room.references]
            queries = [_posed(it, margin_px) for it in room.queries]
            strangers = [_view(it, camera, margin_px) for it in others]
        pipeline = pipeline_of("sift", StationaryOptions())
        most = [max(map(len, pipeline.matcher.match_quickly(it, references))) for it in strangers]
        yield {
            "margin": "no mask" if margin_px is None else f"{margin_px:g} px",
            "matches of other places, median": f"{np.median(most):.0f}",
            "of other places localized": _count([localized(it, references, pipeline) is not None for it in strangers]),
            "of the room localized": _count([localized(it.view, references, pipeline) is not None for it in queries]),
            "features": f"{np.median([len(it.view.features) for it in references]):.0f}",
        }


def _posed(posed: Posed, margin_px: float | None) -> PosedView:
    view = _view(posed.image, posed.camera, margin_px)
    return PosedView(posed.name, posed.name, view, posed.world_from_camera)


def _view(image: Image, camera: Camera, margin_px: float | None) -> View:
    """With a badge, which is opaque and the same in all."""
    drawn, mask = OVERLAYS["badge"](image, 0)
    return SiftExtractor().extract(encoded(drawn), camera, None if margin_px is None else mask)


def _count(some: Sequence[bool]) -> str:
    return f"{sum(some)} of {len(some)}"


MEASUREMENTS = {"mask-margin": Measurement(_rows, needs_scenes=False)}
