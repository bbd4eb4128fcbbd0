"""Priors and scenes as messages: converted with frames and units, and each wrong field is rejected by its name."""

import math
from typing import Any

import numpy as np
import pytest
from google.protobuf.json_format import ParseDict
from hypothesis import given, settings
from hypothesis import strategies as st

from mapless.geodesy import Datum, GeoPosition, geodetic_from_world, world_from_geodetic
from mapless.geometry import Quaternion
from mapless.scenes import Calibration, unit_vector
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless.wire import FieldError
from mapless_server.services.messages.priors import UNKNOWN_HEIGHT_SIGMA_M, needs_attributes, priors_from_message
from mapless_server.services.messages.references import changes_from_message
from mapless_server.store import SceneAttributes

NOTHING = SceneAttributes()
TURN = Quaternion(0.0, 0.0, math.sin(0.35), math.cos(0.35))
DATUM = Datum(47.3769, 8.5417, 450.0, TURN)
ON_EARTH = SceneAttributes(datum=DATUM)
IDENTITY = {"rotation": {"w": 1}, "translationM": {"x": 1, "y": 2, "z": 3}}
SIX = np.diag([0.01] * 3 + [0.001] * 3).ravel().tolist()


def request(**fields: Any) -> pb.LocalizeRequest:
    """A request with these fields, in protobuf's JSON."""
    message = pb.LocalizeRequest()
    ParseDict(fields, message)
    return message


def vector(x: float | str, y: float | str, z: float | str) -> dict[str, float | str]:
    return {"x": x, "y": y, "z": z}


def test_a_position_may_be_limited_and_likely() -> None:
    prior = {"positionM": vector(1, 2, 3), "radiusM": 5, "covarianceM2": [4, 0, 0, 0, 9, 0, 0, 0, 16]}
    narrowing, priors = priors_from_message(request(positionPrior=prior), NOTHING)
    assert narrowing.position is not None
    assert (narrowing.position.position.tolist(), narrowing.position.radius_m) == ([1, 2, 3], 5)
    assert priors.position is not None
    np.testing.assert_array_equal(priors.position.covariance, np.diag([4.0, 9, 16]))


def test_a_radius_is_no_soft_prior_and_a_covariance_no_limit() -> None:
    narrowing, priors = priors_from_message(
        request(positionPrior={"positionM": vector(0, 0, 0), "radiusM": 2}), NOTHING
    )
    assert (priors.position, narrowing.likely_positions) == (None, ())
    soft = {"positionM": vector(0, 0, 0), "covarianceM2": np.eye(3).ravel().tolist()}
    narrowing, priors = priors_from_message(request(positionPrior=soft), NOTHING)
    assert narrowing.position is None
    assert narrowing.contradiction is not None
    # Four standard deviations of a metre and ten metres.
    kept = narrowing.keeps(np.array([[13.9, 0, 0], [14.1, 0, 0]]), np.tile([0, 0, 1.0], (2, 1)))
    assert kept.tolist() == [True, False]


def test_directions_are_brought_to_unit_length() -> None:
    sent = request(
        gravityPrior={"downInCamera": vector(0, 9.81, 0), "sigmaDeg": 1, "downInWorld": vector(0, 0, -3)},
        headingPrior={"direction": vector(0, 2, 0), "sigmaDeg": 5, "maxAngleDeg": 30},
    )
    narrowing, priors = priors_from_message(sent, NOTHING)
    assert priors.gravity is not None
    assert (priors.gravity.in_camera.tolist(), priors.gravity.in_world.tolist()) == ([0, 1, 0], [0, 0, -1])
    assert priors.heading is not None
    assert (priors.heading.in_camera.tolist(), priors.heading.in_world.tolist()) == ([0, 0, 1], [0, 1, 0])
    assert narrowing.heading is not None
    assert narrowing.heading.max_angle_deg == 30


def test_down_in_the_world_is_the_scenes_by_default() -> None:
    sent = request(gravityPrior={"downInCamera": vector(0, 1, 0), "sigmaDeg": 1})
    assert needs_attributes(sent)
    for attributes, down in ((SceneAttributes(down_in_world=(0.0, 1.0, 0.0)), [0, 1, 0]), (ON_EARTH, [0, 0, -1])):
        _, priors = priors_from_message(sent, attributes)
        assert priors.gravity is not None
        np.testing.assert_allclose(priors.gravity.in_world, down, atol=1e-12)
    said = request(gravityPrior={"downInCamera": vector(0, 1, 0), "sigmaDeg": 1, "downInWorld": vector(1, 0, 0)})
    assert not needs_attributes(said)
    _, priors = priors_from_message(said, ON_EARTH)
    assert priors.gravity is not None
    assert priors.gravity.in_world.tolist() == [1, 0, 0]


def test_a_geo_position_is_where_the_datum_puts_it() -> None:
    """There and back through the Earth's frame; the covariance's long axis is east, wherever that is in the world."""
    place = geodetic_from_world([120.0, -35.0, 8.0], DATUM)
    prior = {"latitudeDeg": place.latitude_deg, "longitudeDeg": place.longitude_deg, "heightM": place.height_m}
    sent = request(geoPositionPrior=prior | {"horizontalSigmaM": 4, "verticalSigmaM": 9})
    assert needs_attributes(sent)
    narrowing, priors = priors_from_message(sent, ON_EARTH)
    assert priors.position is not None
    np.testing.assert_allclose(priors.position.position, [120, -35, 8], atol=1e-6)
    np.testing.assert_allclose(priors.position.covariance, np.diag([16, 16, 81.0]), atol=0.01)
    assert len(narrowing.likely_positions) == 1
    assert narrowing.position is None


def test_without_a_height_only_the_horizontal_counts() -> None:
    place = geodetic_from_world([10.0, 5.0, 60.0], DATUM)
    prior = {"latitudeDeg": place.latitude_deg, "longitudeDeg": place.longitude_deg, "horizontalSigmaM": 4}
    _, priors = priors_from_message(request(geoPositionPrior=prior), ON_EARTH)
    assert priors.position is not None
    off = priors.position.position - world_from_geodetic(
        GeoPosition(place.latitude_deg, place.longitude_deg, DATUM.height_m), DATUM
    )
    np.testing.assert_allclose(off, 0, atol=1e-9)
    assert math.sqrt(priors.position.covariance[2, 2]) == pytest.approx(UNKNOWN_HEIGHT_SIGMA_M, rel=1e-3)


def test_a_pose_prior_narrows_position_and_heading() -> None:
    sent = request(posePrior={"worldFromCamera": IDENTITY, "covariance": {"rowMajor": SIX}})
    narrowing, priors = priors_from_message(sent, NOTHING)
    assert priors.pose is not None
    assert priors.pose.world_from_camera.translation.tolist() == [1, 2, 3]
    assert (len(narrowing.likely_positions), len(narrowing.likely_headings)) == (1, 1)
    behind = narrowing.keeps(np.array([[1.0, 2, 3], [1, 2, 3]]), np.array([[0, 0, 1.0], [0, 0, -1]]))
    assert behind.tolist() == [True, False]


def test_a_soft_prior_never_excludes_all_references() -> None:
    soft = {"positionM": vector(1e6, 0, 0), "covarianceM2": np.eye(3).ravel().tolist()}
    narrowing, _ = priors_from_message(request(positionPrior=soft), NOTHING)
    assert narrowing.keeps(np.zeros((3, 3)), np.tile([0, 0, 1.0], (3, 1))).all()


@pytest.mark.parametrize("radius_m", [1e200, 1.7e308])
def test_a_radius_of_any_size_keeps_what_is_inside(radius_m: float) -> None:
    prior = {"positionM": vector(1e7, 0, 0), "radiusM": radius_m}
    for message in (
        request(positionPrior=prior),
        ParseDict({"positionPrior": prior}, reference_pb.RetrieveReferencesRequest()),
    ):
        narrowing, _ = priors_from_message(message, NOTHING)
        far = np.array([[-1e7, -1e7, 1e7], [0.0, 0, 0]])
        assert narrowing.keeps(far, np.eye(3)[:2]).all()


GEO = {"latitudeDeg": 47, "longitudeDeg": 8, "horizontalSigmaM": 5}
GRAVITY = {"downInCamera": vector(0, 1, 0), "sigmaDeg": 1, "downInWorld": vector(0, 0, -1)}
POSITION = {"positionM": vector(0, 0, 0)}
BAD: list[tuple[str, dict[str, Any]]] = [
    ("position_prior.position_m", {"positionPrior": {"radiusM": 1}}),
    ("position_prior.position_m.x", {"positionPrior": {"positionM": vector("NaN", 0, 0), "radiusM": 1}}),
    ("position_prior.position_m.y", {"positionPrior": {"positionM": vector(0, 1.01e7, 0), "radiusM": 1}}),
    ("position_prior.radius_m", {"positionPrior": POSITION}),
    ("position_prior.radius_m", {"positionPrior": POSITION | {"radiusM": -1}}),
    ("position_prior.radius_m", {"positionPrior": POSITION | {"radiusM": "Infinity"}}),
    ("position_prior.covariance_m2", {"positionPrior": POSITION | {"covarianceM2": [1, 2]}}),
    ("position_prior.covariance_m2", {"positionPrior": POSITION | {"covarianceM2": [1, 0, 0, 0, 1, 0, 0, 0, "NaN"]}}),
    ("position_prior.covariance_m2", {"positionPrior": POSITION | {"covarianceM2": [1, 0.5, 0, 0, 1, 0, 0, 0, 1]}}),
    ("position_prior.covariance_m2", {"positionPrior": POSITION | {"covarianceM2": [1, 2, 0, 2, 1, 0, 0, 0, 1]}}),
    ("position_prior.covariance_m2", {"positionPrior": POSITION | {"covarianceM2": [0] * 9}}),
    (
        "position_prior.covariance_m2",
        {"positionPrior": POSITION | {"covarianceM2": (1e13 * np.eye(3)).ravel().tolist()}},
    ),
    (
        "position_prior.covariance_m2",
        {"positionPrior": POSITION | {"covarianceM2": (1e-9 * np.eye(3)).ravel().tolist()}},
    ),
    ("geo_position_prior", {"geoPositionPrior": GEO, "positionPrior": POSITION | {"radiusM": 1}}),
    ("geo_position_prior.latitude_deg", {"geoPositionPrior": GEO | {"latitudeDeg": 91}}),
    ("geo_position_prior.longitude_deg", {"geoPositionPrior": GEO | {"longitudeDeg": 181}}),
    ("geo_position_prior.longitude_deg", {"geoPositionPrior": GEO | {"longitudeDeg": "NaN"}}),
    ("geo_position_prior.horizontal_sigma_m", {"geoPositionPrior": GEO | {"horizontalSigmaM": 0}}),
    ("geo_position_prior.vertical_sigma_m", {"geoPositionPrior": GEO | {"heightM": 3}}),
    ("geo_position_prior.height_m", {"geoPositionPrior": GEO | {"heightM": 1e6, "verticalSigmaM": 3}}),
    ("geo_position_prior.height_m", {"geoPositionPrior": GEO | {"verticalSigmaM": 3}}),
    ("gravity_prior.down_in_camera", {"gravityPrior": {"sigmaDeg": 1}}),
    ("gravity_prior.down_in_camera", {"gravityPrior": GRAVITY | {"downInCamera": vector(0, 0, 0)}}),
    ("gravity_prior.down_in_camera.y", {"gravityPrior": GRAVITY | {"downInCamera": vector(0, "Infinity", 0)}}),
    ("gravity_prior.down_in_world", {"gravityPrior": GRAVITY | {"downInWorld": vector(0, 0, 0)}}),
    ("gravity_prior.sigma_deg", {"gravityPrior": GRAVITY | {"sigmaDeg": 0}}),
    ("gravity_prior.sigma_deg", {"gravityPrior": GRAVITY | {"sigmaDeg": 91}}),
    ("gravity_prior.sigma_deg", {"gravityPrior": GRAVITY | {"sigmaDeg": "NaN"}}),
    ("heading_prior.direction", {"headingPrior": {"sigmaDeg": 1}}),
    ("heading_prior.max_angle_deg", {"headingPrior": {"direction": vector(1, 0, 0)}}),
    ("heading_prior.max_angle_deg", {"headingPrior": {"direction": vector(1, 0, 0), "maxAngleDeg": 181}}),
    ("heading_prior.sigma_deg", {"headingPrior": {"direction": vector(1, 0, 0), "sigmaDeg": -1}}),
    ("pose_prior.world_from_camera", {"posePrior": {"covariance": {"rowMajor": SIX}}}),
    ("pose_prior.covariance", {"posePrior": {"worldFromCamera": IDENTITY}}),
    (
        "pose_prior.covariance.row_major",
        {"posePrior": {"worldFromCamera": IDENTITY, "covariance": {"rowMajor": SIX[:9]}}},
    ),
    (
        "pose_prior.covariance.row_major",
        {"posePrior": {"worldFromCamera": IDENTITY, "covariance": {"rowMajor": [0] * 36}}},
    ),
    (
        "pose_prior.world_from_camera.rotation",
        {"posePrior": {"worldFromCamera": IDENTITY | {"rotation": {"w": 2}}, "covariance": {"rowMajor": SIX}}},
    ),
]


@pytest.mark.parametrize(("field", "fields"), BAD, ids=[f"{i} {field}" for i, (field, _) in enumerate(BAD)])
def test_a_wrong_field_is_rejected_by_name(field: str, fields: dict[str, Any]) -> None:
    with pytest.raises(FieldError) as error:
        priors_from_message(request(**fields), ON_EARTH)
    assert error.value.field == field


def test_a_rotation_too_sure_is_named_with_its_sigma() -> None:
    sure = np.diag([0.01] * 3 + [1e-12, 0.01, 0.01]).ravel().tolist()
    with pytest.raises(FieldError, match=r"1\.7e-05 to 6\.28 radians, has 1e-06 to 0\.1"):
        priors_from_message(request(posePrior={"worldFromCamera": IDENTITY, "covariance": {"rowMajor": sure}}), NOTHING)


def test_a_certain_geo_position_without_a_height_is_a_prior() -> None:
    _, priors = priors_from_message(request(geoPositionPrior=GEO | {"horizontalSigmaM": 1e-4}), ON_EARTH)
    assert priors.position is not None
    sigmas_m = np.sqrt(np.linalg.eigvalsh(priors.position.covariance))
    np.testing.assert_allclose(sigmas_m, [0.01, 0.01, 1000.0], rtol=1e-4)


@pytest.mark.parametrize("seconds", [0, 1, 10**15, -(10**15)])
def test_the_caller_does_not_set_when_a_calibration_was_stored(seconds: int) -> None:
    calibration = reference_pb.SceneCalibration(
        position_factor_68=1.0,
        position_factor_95=1.5,
        rotation_factor_68=1.0,
        rotation_factor_95=2.0,
        query_count=7,
        variant=pb.VARIANT_BEST,
    )
    calibration.create_time.seconds = seconds
    sent = reference_pb.UpdateSceneRequest(scene=reference_pb.Scene(name="scenes/hall", calibration=calibration))
    sent.update_mask.paths.append("calibration")
    changes = changes_from_message(sent)
    stored = changes["calibration"]
    assert isinstance(stored, Calibration)
    assert (stored.create_time, stored.query_count, stored.rotation_factor_95) == (None, 7, 2.0)
    assert sent.scene.calibration.create_time.seconds == seconds  # the request itself is left alone


@settings(deadline=None)
@given(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3))
def test_directions_are_of_unit_length_whatever_they_were(vector: tuple[float, float, float]) -> None:
    """Also of vectors whose squares are no numbers."""
    if not any(vector):
        with pytest.raises(ValueError, match="not zero"):
            unit_vector(*vector)
        return
    found = np.array(unit_vector(*vector))
    assert np.linalg.norm(found) == pytest.approx(1)
    largest = np.abs(vector).max()
    np.testing.assert_allclose(
        found * np.linalg.norm(np.array(vector) / largest), np.array(vector) / largest, atol=1e-12
    )
