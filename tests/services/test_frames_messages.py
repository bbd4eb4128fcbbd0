"""Frames and cameras as messages; the conversions have tests of their own."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from google.protobuf import json_format
from support.servers import CAMERA, PHOTO

from mapless import Fisheye, RadialTangential, wire
from mapless.answers import Rejected
from mapless.axes import Axes
from mapless.geodesy import Datum, GeoPose
from mapless.geometry import Quaternion, RigidTransform
from mapless.messages import answer_from_message
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.options import EngineOptions
from mapless_server.images import ImageLimits
from mapless_server.method.bundle.priors import IntrinsicsSigma
from mapless_server.method.bundle.readout import ReadoutDirection, RollingShutter
from mapless_server.method.groups.velocity import CORRELATION_S
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.rejection import IntrinsicsCheck, IntrinsicsParameter, Rejection, RejectionReason
from mapless_server.services.messages.answers import (
    axes_from_message,
    rejection_to_message,
    session_from_message,
    set_frames,
)
from mapless_server.services.messages.groups import queries_from_message, with_tracked_motion
from mapless_server.services.messages.queries import photo_from_message, query_from_message
from mapless_server.store import SceneAttributes

AXES: wire.ProtoEnum = pb.Axes
H = math.sqrt(0.5)
# In a world with y up: at (1, 2, 3), looks along +x, upright, so its right is +z.
LOOKS_ALONG_X = RigidTransform(np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]]), np.array([1.0, 2.0, 3.0]))
# In a world with x east, y north, z up: at the origin, looks east, upright, so its right is south.
LOOKS_EAST = RigidTransform(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
COVARIANCE = np.arange(36.0).reshape(6, 6)


def test_a_headset_is_given_all_it_needs_in_its_own_axes() -> None:
    """Unity's camera looks along its z: it turns by 90 degrees about y, up, to look along x; z is mirrored."""
    session_from_camera = RigidTransform(np.eye(3), np.array([0.0, 0.0, 5.0]))
    message = pb.Localization()
    set_frames(message, LOOKS_ALONG_X, COVARIANCE, Axes.UNITY, session_from_camera, None)
    framed = message.in_axes
    assert framed.axes == pb.AXES_UNITY
    assert quaternion_of(framed.world_from_camera) == pytest.approx((0, H, 0, H))
    assert translation_of(framed.world_from_camera) == pytest.approx((1, 2, -3))
    signs = np.array([1, 1, -1, -1, -1, 1])
    np.testing.assert_array_equal(np.reshape(framed.covariance.row_major, (6, 6)), COVARIANCE * np.outer(signs, signs))
    # The session's origin is 5 m behind the camera: at x = 1 - 5.
    assert quaternion_of(framed.world_from_session) == pytest.approx((0, H, 0, H))
    assert translation_of(framed.world_from_session) == pytest.approx((-4, 2, -3))
    assert not message.HasField("geo_pose")


@pytest.mark.parametrize("axes", Axes)
def test_unknown_fields_are_absent_and_not_zero(axes: Axes) -> None:
    message = pb.Localization()
    set_frames(message, LOOKS_ALONG_X, None, axes, None, None)
    assert {field.name for field, _ in message.in_axes.ListFields()} == {"axes", "world_from_camera"}
    assert AXES.Name(message.in_axes.axes) == f"AXES_{axes.name}"


def test_opencvs_axes_are_the_default() -> None:
    message = pb.Localization()
    axes = axes_from_message(pb.LocalizeOptions())
    set_frames(message, LOOKS_ALONG_X, COVARIANCE, axes, LOOKS_ALONG_X, None)
    assert message.in_axes.axes == pb.AXES_OPENCV
    assert message.in_axes.world_from_camera == wire.transform_to_message(LOOKS_ALONG_X)
    np.testing.assert_array_equal(message.in_axes.covariance.row_major, COVARIANCE.ravel())
    found = wire.transform_from_message(message.in_axes.world_from_session, "")
    np.testing.assert_allclose(found.matrix(), np.eye(4), atol=1e-12)


def test_json_of_a_geopose_is_the_standards_with_its_zeros() -> None:
    message = pb.Localization()
    set_frames(message, LOOKS_EAST, None, Axes.OPENCV, None, Datum(0, 0, 0))
    content = json_format.MessageToDict(message.geo_pose)
    assert set(content) == {"position", "quaternion"}
    assert (set(content["position"]), set(content["quaternion"])) == ({"lat", "lon", "h"}, {"x", "y", "z", "w"})
    found = GeoPose.from_json(content)
    assert (found.lat, found.lon, found.h) == pytest.approx((0, 0, 0), abs=1e-9)
    assert tuple(vars(found.quaternion).values()) == pytest.approx((0, 0, 0, 1), abs=1e-9)


@pytest.mark.parametrize("far_m", [1.01e7, -1e300, 1.7e308])
def test_a_session_pose_too_far_away_to_add_is_refused(far_m: float) -> None:
    request = pb.LocalizeRequest(session_from_camera=wire.transform_to_message(LOOKS_ALONG_X))
    assert session_from_message(request) is not None
    request.session_from_camera.translation_m.z = far_m
    with pytest.raises(FieldError) as caught:
        session_from_message(request)
    assert caught.value.field == "session_from_camera.translation_m.z"


def test_unknown_axes_are_rejected() -> None:
    for number in (6, -1):
        with pytest.raises(FieldError) as caught:
            axes_from_message(pb.LocalizeOptions(axes=number))  # type: ignore[arg-type]
        assert caught.value.field == "options.axes"
    names = {axes_from_message(pb.LocalizeOptions(axes=number)) for number in AXES.values()}
    assert names == set(Axes)


def test_a_session_pose_is_read_as_given() -> None:
    request = pb.LocalizeRequest()
    assert session_from_message(request) is None
    request.session_from_camera.CopyFrom(wire.transform_to_message(LOOKS_ALONG_X))
    found = session_from_message(request)
    assert found is not None
    np.testing.assert_allclose(found.matrix(), LOOKS_ALONG_X.matrix(), atol=1e-12)
    request.session_from_camera.rotation.w = 3
    with pytest.raises(FieldError) as caught:
        session_from_message(request)
    assert caught.value.field == "session_from_camera.rotation"


def quaternion_of(message: object) -> tuple[float, ...]:
    q: Quaternion = wire.transform_from_message(message, "").quaternion()  # type: ignore[arg-type]
    return q.x, q.y, q.z, q.w


def translation_of(message: object) -> tuple[float, ...]:
    return tuple(wire.transform_from_message(message, "").translation)  # type: ignore[arg-type]


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
        sigma_of(pb.IntrinsicsUncertainty(**{field: value}))  # type: ignore[arg-type]
    assert caught.value.field == f"intrinsics_uncertainty.{field}"


def shutter_of(**given: float) -> LocalizeOptions:
    uncertainty = pb.IntrinsicsUncertainty()
    for field, value in given.items():
        setattr(uncertainty, field, value)
    request = pb.LocalizeRequest(scene="scenes/hall", image=PHOTO, intrinsics_uncertainty=uncertainty)
    return query_from_message(request, "", EngineOptions(), SceneAttributes()).options


def test_a_read_out_needs_no_intrinsics_and_leaves_their_sigma() -> None:
    found = shutter_of(readout_s=0.03, readout_direction=pb.READOUT_DIRECTION_RIGHT_TO_LEFT, speed_m_per_s=1.5)
    assert found.shutter == RollingShutter(0.03, ReadoutDirection.RIGHT_TO_LEFT, 1.5)
    assert found.intrinsics is None
    assert sigma_of(pb.IntrinsicsUncertainty(readout_s=0.03)) is None
    assert sigma_of(pb.IntrinsicsUncertainty(readout_s=0.03, k1_sigma=0.05)) == IntrinsicsSigma(k1=0.05)
    assert sigma_of(pb.IntrinsicsUncertainty(turn_deg_per_s=0)) == IntrinsicsSigma()


@pytest.mark.parametrize("value", [-0.01, 1e-300, math.nan, math.inf, 1e5])
@pytest.mark.parametrize(("field", "most"), [("readout_s", 0.2), ("speed_m_per_s", 1000), ("turn_deg_per_s", 3600)])
def test_bad_read_outs_and_speeds_are_named_with_their_bound(field: str, most: float, value: float) -> None:
    with pytest.raises(
        FieldError, match=re.escape(f"must be 0, or 1e-06 to {most:g} ") + ".*" + re.escape(f"is {value:g}")
    ) as caught:
        shutter_of(**{"readout_s": 0.03, field: value})
    assert caught.value.field == f"intrinsics_uncertainty.{field}"


def test_speeds_and_sigmas_without_their_owner_are_refused() -> None:
    with pytest.raises(FieldError, match="is of a rolling shutter, and readout_s is 0"):
        shutter_of(speed_m_per_s=1.0)
    with pytest.raises(FieldError, match="is that of intrinsics, and there are none"):
        shutter_of(readout_s=0.03, focal_sigma_px=3.0)
    with pytest.raises(FieldError, match="must be one of ReadoutDirection's values, is 9"):
        shutter_of(readout_s=0.03, readout_direction=9)


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


def photographed(lens: RadialTangential | Fisheye) -> pb.LocalizeRequest:
    return pb.LocalizeRequest(image=PHOTO, intrinsics=wire.camera_to_message(replace(CAMERA, distortion=lens)))


@pytest.mark.parametrize("lens", [RadialTangential(k1=-100.0), Fisheye(k1=-100.0)])
def test_a_lens_that_shows_nothing_is_named(lens: RadialTangential | Fisheye) -> None:
    with pytest.raises(FieldError, match=r"k1 = -100.* only 0 % of its pixels have a ray") as caught:
        photo_from_message(photographed(lens), "", ImageLimits())
    assert caught.value.field == f"intrinsics.{'fisheye' if isinstance(lens, Fisheye) else 'radial_tangential'}"


@pytest.mark.parametrize(
    "lens", [RadialTangential(-0.4, 0.2, 1e-3, 1e-3, -0.05), RadialTangential(k1=0.5), Fisheye(), Fisheye(0.1, -0.02)]
)
def test_lenses_in_use_are_accepted(lens: RadialTangential | Fisheye) -> None:
    assert photo_from_message(photographed(lens), "", ImageLimits()).camera.distortion == lens


@pytest.mark.parametrize("ignored", [False, True])
def test_a_rig_ignores_the_calibration_for_each_photograph(ignored: bool) -> None:
    image = pb.RigImage(image=PHOTO, intrinsics=wire.camera_to_message(CAMERA))
    options = pb.LocalizeOptions(ignore_calibration=ignored)
    rig = pb.LocalizeRigRequest(scene="scenes/hall", images=[image, image], options=options)
    queries = queries_from_message(rig, "images", (1, 8), "", EngineOptions(), SceneAttributes())
    assert [it.is_generic for it in queries] == [ignored, ignored]


def test_times_and_poses_of_frames_say_how_a_camera_moved() -> None:
    frames = [pb.SequenceFrame(image=PHOTO, intrinsics=wire.camera_to_message(CAMERA)) for _ in range(2)]
    poses = [RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.1 * i])) for i in range(2)]
    for i, frame in enumerate(frames):
        frame.intrinsics_uncertainty.readout_s = 0.02
        frame.capture_time.FromMilliseconds(1_700_000_000_000 + 100 * i)
        frame.session_from_camera.CopyFrom(wire.transform_to_message(poses[i]))
    request = pb.LocalizeSequenceRequest(scene="scenes/hall", frames=frames)
    queries = queries_from_message(request, "frames", (2, 16), "", EngineOptions(), SceneAttributes())
    for query in with_tracked_motion(queries, request, poses):
        assert query.options.shutter is not None
        assert query.options.shutter.tracked is not None
        known = math.exp(-0.05 / CORRELATION_S)
        expected = [0, 0, -0.02 * known, 0, 0, 0]
        np.testing.assert_allclose(query.options.shutter.tracked.mean, expected, atol=1e-6)
