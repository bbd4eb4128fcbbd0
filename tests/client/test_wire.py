"""Geometry crosses the wire unchanged, and what breaks the contract is named by its path."""

import math
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from typing import Any

import numpy as np
import pytest

from mapless import AdoptionPolicy, Client, names, wire
from mapless.geometry import MAX_COORDINATE_M, Camera, RigidTransform
from mapless.groups import RigImage, SequenceFrame
from mapless.priors import PositionPrior, Priors, set_priors
from mapless.requests import IntrinsicsUncertainty, NewReference, create_request
from mapless.v1 import geometry_pb2 as pb
from mapless.v1.localization_service_pb2 import LocalizeRequest

CAMERA = Camera(640, 480, 500.0, 501.5, 319.5, 239.25)


def changed(**values: Any) -> Camera:
    """The camera with values of any type."""
    return replace(CAMERA, **values)


@pytest.mark.parametrize(
    ("convert", "value", "error_text"),
    [
        (wire.camera_to_message, "camera.json", "camera must be a Camera, is str; read_camera"),
        (wire.camera_to_message, changed(width_px=640.0), "camera.width_px must be a whole number, is 640.0"),
        (wire.camera_to_message, changed(focal_x_px="5"), "camera.focal_x_px must be a number, is '5'"),
        (wire.transform_to_message, np.eye(4), "must be a RigidTransform, is numpy.ndarray; "),
        (lambda it: names.reference_names("s", it), "r1", "references must be a list of .*, is the text 'r1'"),
        (
            lambda it: names.reference_names("s", it),
            ["r1", None],
            r"references\[1\] must be an id or a name, is 'None'",
        ),
        (
            lambda it: set_priors(None, it),
            PositionPrior(np.zeros(3), 1.0),
            "must be a Priors, is mapless.priors.PositionPrior; such as",
        ),
        (
            lambda it: create_request("s", it),
            NewReference(3, b"x", CAMERA, RigidTransform.identity()),  # type: ignore[arg-type]
            "reference.reference_id must be a text, is 3",
        ),
        (
            lambda it: Client("localhost").localize(b"x", CAMERA, "s", intrinsics_uncertainty=it),
            40,
            "must be an IntrinsicsUncertainty, is int; such as",
        ),
        (
            lambda it: Client("localhost").localize_sequence(it, "s"),
            ["a.jpg"],
            r"frames\[0\] must be a SequenceFrame, is str; one is made by SequenceFrame\(image, camera, session_from",
        ),
        (
            lambda it: Client("localhost").localize_sequence([SequenceFrame(b"x", CAMERA, it)], "s"),
            np.eye(4),
            r"frames\[0\]\.session_from_camera must be a RigidTransform, is numpy.ndarray; ",
        ),
        (
            lambda it: Client("localhost").localize_rig(it, "s"),
            None,
            "images must be a list of RigImage, is NoneType; ",
        ),
        (
            lambda it: Client("localhost").localize_rig([RigImage(b"x", it, RigidTransform.identity())], "s"),
            "camera.json",
            r"images\[0\]\.camera must be a Camera, is str; read_camera",
        ),
        (
            lambda it: Client("localhost").add_references("s", it),
            ["a.jpg"],
            r"references\[0\] must be a NewReference, ",
        ),
        (lambda it: Client("localhost").add_reference("s", it), "a.jpg", "reference must be a NewReference, is str; "),
        (lambda it: Client("localhost").localize(b"x", CAMERA, it), None, "scene must be its id or name, is None"),
        (lambda it: Client("localhost").localize(b"x", CAMERA, "s", coverage=it), "3", "coverage must be a number, is"),
        (
            lambda it: Client("localhost").undo_adoption("s", it),
            date(2027, 1, 1),
            "since must be a datetime, is datetime.d",
        ),
        (
            lambda it: Client("localhost").restore_references("s", since=it),
            "2027-01-01",
            "since must be a datetime, is str",
        ),
        (
            lambda it: Client("localhost").get_scene_report("s", days_per_period=it),
            1.5,
            "days_per_period must be a whole",
        ),
        (lambda it: AdoptionPolicy(max_radius_m=it), "0.1", "max_radius_m must be a number, is '0.1'"),
        (lambda it: AdoptionPolicy(most_per_place=it), True, "most_per_place must be a whole number, is True"),
        (lambda it: AdoptionPolicy(min_surveyed_share=it), None, "min_surveyed_share must be a number, is None"),
    ],
)
def test_a_value_of_another_type_is_named(convert: Callable[[Any], Any], value: Any, error_text: str) -> None:
    with pytest.raises(TypeError, match=error_text):
        convert(value)


def test_a_number_that_a_field_cannot_hold_is_named() -> None:
    with pytest.raises(ValueError, match="days_per_period is out of the field's range, is 10000000"):
        Client("localhost").get_scene_report("s", days_per_period=10**20)


def test_an_unknown_side_of_a_read_out_is_named() -> None:
    uncertainty = IntrinsicsUncertainty(readout_s=0.03, readout_direction="down")
    with pytest.raises(ValueError, match="ReadoutDirection must be one of top_to_bottom, bottom_to_top, left_to"):
        Client("localhost").localize(b"x", CAMERA, "s", intrinsics_uncertainty=uncertainty)


def test_a_prior_with_too_few_coordinates_is_named() -> None:
    with pytest.raises(ValueError, match=r"position_m must have three numbers, x, y and z, is \[1.0, 2.0\]"):
        set_priors(LocalizeRequest(), Priors(position=PositionPrior(np.array([1.0, 2.0]), 1.0)))


def test_an_empty_scene_is_named() -> None:
    with pytest.raises(ValueError, match="scene, scenes or group is required"):
        Client("localhost").localize(b"x", CAMERA, "")


def test_a_missing_argument_is_reported_by_the_call_s_own_name() -> None:
    with pytest.raises(TypeError, match=r"^add_reference\(\) missing 1 required positional argument: 'reference'"):
        Client("localhost").add_reference("kitchen")  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="scene, scenes or group is required"):
        Client("localhost").localize(b"x")


def test_a_reference_whose_rotation_is_none_is_not_sent() -> None:
    scaled = RigidTransform(2 * np.eye(3), np.zeros(3))
    with pytest.raises(ValueError, match="world_from_camera of reference 'r': rotation is not an orthonormal"):
        create_request("scenes/s", NewReference("r", b"x", CAMERA, scaled))


def test_a_quaternion_is_normalized() -> None:
    message = pb.RigidTransform(rotation=pb.Quaternion(w=1.0005), translation_m=pb.Vector3())
    np.testing.assert_allclose(wire.transform_from_message(message, "pose").rotation, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"width_px": 31}, "width_px"),
        ({"height_px": 16385}, "height_px"),
        ({"width_px": -640}, "width_px"),
        ({"focal_x_px": 0.0}, "focal_x_px"),
        ({"focal_x_px": 5e-324}, "focal_x_px"),
        ({"focal_y_px": 6.39}, "focal_y_px"),
        ({"focal_y_px": -500.0}, "focal_y_px"),
        ({"focal_x_px": math.nan}, "focal_x_px"),
        ({"focal_y_px": math.inf}, "focal_y_px"),
        ({"focal_x_px": 64001.0}, "focal_x_px"),
        ({"principal_x_px": -641.0}, "principal_x_px"),
        ({"principal_x_px": math.nan}, "principal_x_px"),
        ({"principal_y_px": 961.0}, "principal_y_px"),
        ({"radial_tangential": pb.RadialTangentialDistortion(k2=101)}, "radial_tangential.k2"),
        ({"radial_tangential": pb.RadialTangentialDistortion(p1=math.nan)}, "radial_tangential.p1"),
        ({"fisheye": pb.FisheyeDistortion(k4=-math.inf)}, "fisheye.k4"),
    ],
)
def test_bad_cameras_are_refused_by_field(change: dict[str, Any], field: str) -> None:
    message = wire.camera_to_message(CAMERA)
    message.MergeFrom(pb.CameraIntrinsics(**change))
    for name, value in change.items():
        if isinstance(value, int | float):
            setattr(message, name, value)  # merging leaves out zeros
    with pytest.raises(wire.FieldError) as caught:
        wire.camera_from_message(message, "requests[3].reference.intrinsics")
    assert caught.value.field == f"requests[3].reference.intrinsics.{field}"


def test_camera_limits_are_inclusive() -> None:
    camera = Camera(32, 16384, 100.0 * 16384, 0.01 * 16384, -32.0, 2.0 * 16384)
    assert wire.camera_from_message(wire.camera_to_message(camera), "") == camera


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (pb.RigidTransform(translation_m=pb.Vector3()), "rotation"),
        (pb.RigidTransform(rotation=pb.Quaternion(w=1)), "translation_m"),
        (pb.RigidTransform(rotation=pb.Quaternion(), translation_m=pb.Vector3()), "rotation"),
        (pb.RigidTransform(rotation=pb.Quaternion(w=1.002), translation_m=pb.Vector3()), "rotation"),
        (pb.RigidTransform(rotation=pb.Quaternion(x=math.nan, w=1), translation_m=pb.Vector3()), "rotation"),
        (pb.RigidTransform(rotation=pb.Quaternion(w=1), translation_m=pb.Vector3(z=math.inf)), "translation_m.z"),
        (pb.RigidTransform(rotation=pb.Quaternion(w=1), translation_m=pb.Vector3(y=-1.1e7)), "translation_m.y"),
    ],
)
def test_bad_transforms_are_refused_by_field(message: pb.RigidTransform, field: str) -> None:
    with pytest.raises(wire.FieldError) as caught:
        wire.transform_from_message(message, "pose", MAX_COORDINATE_M)
    assert caught.value.field == f"pose.{field}"


@pytest.mark.parametrize("good", ["a", "_", "A-b.c_9", "0" * 128, "a.b-c"])
def test_ids(good: str) -> None:
    assert names.parse_scene_name(names.scene_name(good)) == good
    assert names.parse_reference_name(names.reference_name("scene", good)) == ("scene", good)


@pytest.mark.parametrize(
    "bad", ["", ".", "..", "-a", "a-", ".a", "a.", "a..b", "a/b", "a b", "a\n", "ä", "0" * 129, "x" * 10_000, "a\0b"]
)
def test_bad_ids(bad: str) -> None:
    with pytest.raises(ValueError, match=r"\A[ -~]{1,400}\Z"):  # short and printable: it goes into logs and trailers
        names.check_id(bad)
    with pytest.raises(wire.FieldError):
        wire.scene_id_from_name(f"scenes/{bad}", "scene")
    with pytest.raises(wire.FieldError):
        wire.reference_ids_from_name(f"scenes/s/references/{bad}", "name")


@pytest.mark.parametrize(
    "bad", ["", "scenes", "scene/a", "scenes/a/references", "a", "/scenes/a", "scenes//references/b"]
)
def test_bad_names(bad: str) -> None:
    with pytest.raises(ValueError, match=r".+"):
        names.parse_scene_name(bad)
    with pytest.raises(ValueError, match=r".+"):
        names.parse_reference_name(bad)
