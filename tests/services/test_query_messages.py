"""A photograph's camera: one whose lens shows nothing of the image is an error, not a photograph without features."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.servers import CAMERA, PHOTO

from mapless import Fisheye, RadialTangential, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.images import ImageLimits
from mapless_server.services.messages.queries import photo_from_message


def request(lens: RadialTangential | Fisheye) -> pb.LocalizeRequest:
    return pb.LocalizeRequest(image=PHOTO, intrinsics=wire.camera_to_message(replace(CAMERA, distortion=lens)))


@pytest.mark.parametrize("lens", [RadialTangential(k1=-100.0), Fisheye(k1=-100.0)])
def test_a_lens_that_shows_nothing_is_named(lens: RadialTangential | Fisheye) -> None:
    with pytest.raises(FieldError, match=r"k1 = -100.* only 0 % of its pixels have a ray") as caught:
        photo_from_message(request(lens), "", ImageLimits())
    assert caught.value.field == f"intrinsics.{'fisheye' if isinstance(lens, Fisheye) else 'radial_tangential'}"


@pytest.mark.parametrize(
    "lens", [RadialTangential(-0.4, 0.2, 1e-3, 1e-3, -0.05), RadialTangential(k1=0.5), Fisheye(), Fisheye(0.1, -0.02)]
)
def test_lenses_in_use_are_accepted(lens: RadialTangential | Fisheye) -> None:
    assert photo_from_message(request(lens), "", ImageLimits()).camera.distortion == lens
