"""A photograph's camera, whose lens must show the image, and options that hold for each photograph of a rig."""

from dataclasses import replace

import pytest
from support.servers import CAMERA, PHOTO

from mapless import Fisheye, RadialTangential, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.interface import EngineOptions
from mapless_server.images import ImageLimits
from mapless_server.services.messages.groups import queries_from_message
from mapless_server.services.messages.queries import photo_from_message
from mapless_server.store import SceneAttributes


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


@pytest.mark.parametrize("ignored", [False, True])
def test_a_rig_ignores_the_calibration_for_each_photograph(ignored: bool) -> None:
    image = pb.RigImage(image=PHOTO, intrinsics=wire.camera_to_message(CAMERA))
    options = pb.LocalizeOptions(ignore_calibration=ignored)
    rig = pb.LocalizeRigRequest(scene="scenes/hall", images=[image, image], options=options)
    queries = queries_from_message(rig, "images", (1, 8), "", EngineOptions(), SceneAttributes())
    assert [it.is_generic for it in queries] == [ignored, ignored]
