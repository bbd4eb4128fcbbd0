"""A photograph's camera in messages: its lens and how far it may be off; options of a rig."""

import math
import re
from dataclasses import replace

import pytest
from support.servers import CAMERA, PHOTO

from mapless import Fisheye, RadialTangential, wire
from mapless.answer_messages import answer_from_message
from mapless.answers import Rejected
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.interface import EngineOptions
from mapless_server.images import ImageLimits
from mapless_server.method.options import IntrinsicsSigma
from mapless_server.method.rejection import IntrinsicsCheck, IntrinsicsParameter, Rejection, RejectionReason
from mapless_server.services.messages.answers import rejection_to_message
from mapless_server.services.messages.groups import queries_from_message
from mapless_server.services.messages.queries import photo_from_message, query_from_message
from mapless_server.store import SceneAttributes


def sigma_of(uncertainty: pb.IntrinsicsUncertainty | None) -> IntrinsicsSigma | None:
    request = pb.LocalizeRequest(
        scene="scenes/hall", image=PHOTO, intrinsics=wire.camera_to_message(CAMERA), intrinsics_uncertainty=uncertainty
    )
    return query_from_message(request, "", EngineOptions(), SceneAttributes()).options.intrinsics


def test_standard_deviations_become_shares() -> None:
    given = pb.IntrinsicsUncertainty(
        focal_sigma_px=0.02 * CAMERA.focal_x_px, principal_sigma_px=0.01 * CAMERA.width_px, k1_sigma=0.05
    )
    found = sigma_of(given)
    assert found
    assert found.focal_share == pytest.approx(0.02)
    assert found.principal_share == pytest.approx(0.01)
    assert found.k1 == 0.05


def test_zeros_are_the_defaults_and_absence_leaves_the_choice() -> None:
    """Without the message, intrinsics are more certain where the references share the camera."""
    assert sigma_of(None) is None
    assert sigma_of(pb.IntrinsicsUncertainty()) == IntrinsicsSigma()
    assert sigma_of(pb.IntrinsicsUncertainty(k1_sigma=1e-300)) == IntrinsicsSigma(k1=1e-6)


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf, 1e6, -math.inf])
@pytest.mark.parametrize(
    ("field", "most"), [("focal_sigma_px", CAMERA.focal_x_px), ("principal_sigma_px", CAMERA.width_px), ("k1_sigma", 1)]
)
def test_bad_standard_deviations_are_named_with_their_bound(field: str, most: float, value: float) -> None:
    message = re.escape(f"above 0 and at most {most:g}, or 0 for the default, is {value:g}")
    with pytest.raises(FieldError, match=message) as caught:
        sigma_of(pb.IntrinsicsUncertainty(**{field: value}))
    assert caught.value.field == f"intrinsics_uncertainty.{field}"


def test_a_rejection_carries_its_checks_to_the_client() -> None:
    check = IntrinsicsCheck(IntrinsicsParameter.FOCAL_LENGTH, 525.0, 541.0, 2.0, 1.575, conflict=True, used=True)
    rejection = Rejection(RejectionReason.GATE, "planted", intrinsics_checks=(check,))
    answer = answer_from_message(pb.LocalizeResponse(rejection=rejection_to_message(rejection)))
    assert isinstance(answer, Rejected)
    (found,) = answer.intrinsics_checks
    assert found.parameter == "FOCAL_LENGTH"
    assert (found.given, found.estimated, found.estimated_sigma, found.given_sigma) == (525.0, 541.0, 2.0, 1.575)
    assert found.conflict
    assert found.used


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
