"""A photograph between the attempts of a query: what was computed of it is not computed again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.depths import png
from support.images import encode, textured

from mapless import Camera, DepthImage, RigidTransform
from mapless_server.engine.photo_views import QueryViews
from mapless_server.engine.query import Photo
from mapless_server.images import ImageLimits
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.options import StageContext
from mapless_server.method.structure.measured_depth import MeasuredDepth

CAMERA = Camera.centred(320, 240, 260.0)


def test_depth_is_moved_to_the_photograph_once(monkeypatch: pytest.MonkeyPatch) -> None:
    moved, seen_by = list[Camera](), MeasuredDepth.seen_by

    def counted(self: MeasuredDepth, camera: Camera) -> MeasuredDepth:
        moved.append(camera)
        return seen_by(self, camera)

    monkeypatch.setattr(MeasuredDepth, "seen_by", counted)
    beside = RigidTransform(np.eye(3), np.array([0.05, 0.0, 0.0]))
    depth = DepthImage(png(np.full((240, 320), 2000, np.uint16)), 0.001, camera=CAMERA, camera_from_depth_camera=beside)
    views = QueryViews(Photo(encode(".png", textured(320, 240)), CAMERA, "image", depth=depth), ImageLimits())
    view = views.view(SiftExtractor(), StageContext(lambda: None))
    first, second = view.with_depths(), replace(view).with_depths()
    assert moved == [CAMERA.pinhole()]
    assert first.depths is not None
    assert second.depths is not None
    np.testing.assert_array_equal(first.depths.depth, second.depths.depth)
