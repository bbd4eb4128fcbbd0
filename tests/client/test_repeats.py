"""A change whose answer was lost: what is found counts as ours if it is all that we sent, else as another caller's.

And whatever a server answers, a client raises no errors but its own.
"""

import hashlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import Message
from support.clients import Played

from mapless import wire
from mapless.calls import groups, localization, references, repeats, scenes
from mapless.connection import Connection
from mapless.depth import DepthImage, IgnoredDepth
from mapless.errors import AlreadyExists, Internal, NotFound, Unavailable
from mapless.geodesy import Datum
from mapless.geometry import Camera, Quaternion, RigidTransform
from mapless.options import ConnectOptions
from mapless.requests import NewReference, create_request
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb

GONE = Unavailable("UNAVAILABLE", "gone")
TAKEN = AlreadyExists("ALREADY_EXISTS", "taken")
ABSENT = NotFound("NOT_FOUND", "absent")
DATUM = Datum(47.0, 8.0, 400.0, Quaternion(0.0, 0.0, math.sin(0.3), math.cos(0.3)))
DOWN = (0.0, 9.81, 0.3)
CAMERA = Camera(640, 480, 500, 500, 320, 240)


def created(there: Any, generation: int = 1) -> Any:
    """The result of `create_scene` with DATUM and DOWN if this scene is there after a lost answer."""
    there = pb.GetSceneResponse(
        scene=pb.Scene(name="scenes/hall", generation=generation, datum=there.datum, down_in_world=there.down_in_world)
        if isinstance(there, pb.CreateSceneRequest)
        else there
    )
    return Played(create, [GONE, TAKEN, there], ConnectOptions()).result


def create(connection: Connection) -> Any:
    return scenes.create_scene(connection, "hall", datum=DATUM, down_in_world=DOWN)


def sent() -> pb.CreateSceneRequest:
    (_, request), *_ = Played(create, [GONE], ConnectOptions(max_attempts=1)).calls
    assert isinstance(request, pb.CreateSceneRequest)
    return request


def test_a_scene_normalized_by_the_server_is_still_ours() -> None:
    there = sent()
    length = math.hypot(*DOWN)
    for axis in ("x", "y", "z"):
        setattr(there.down_in_world, axis, getattr(there.down_in_world, axis) / length)
    for axis in ("x", "y", "z", "w"):  # of a quaternion and its opposite, which turn alike
        q = there.datum.enu_from_world
        setattr(q, axis, -getattr(q, axis) * (1 + 1e-15))
    assert created(there).datum.latitude_deg == 47.0


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("datum.latitude_deg", -33.0),
        ("datum.longitude_deg", 8.0000001),
        ("datum.height_m", 400.001),
        ("datum.enu_from_world.z", 0.2955202),
        ("down_in_world.x", 0.001),
    ],
)
def test_a_scene_of_another_world_is_not_ours(path: str, value: float) -> None:
    there = sent()
    *parents, name = path.split(".")
    part: Any = there
    for parent in parents:
        part = getattr(part, parent)
    setattr(part, name, value)
    assert created(there) is TAKEN


def test_a_scene_that_was_changed_or_lacks_fields_is_not_ours() -> None:
    assert created(pb.Scene(name="scenes/hall", generation=1)) is TAKEN
    assert created(pb.Scene(name="scenes/hall", generation=1, datum=sent().datum)) is TAKEN
    assert created(sent(), generation=2) is TAKEN
    assert created(sent()).scene_id == "hall"


def requests(count: int) -> list[pb.CreateReferenceRequest]:
    pose = RigidTransform(np.eye(3), np.zeros(3))
    return [create_request("scenes/a", NewReference(f"r{i:02}", b"photo %d" % i, CAMERA, pose)) for i in range(count)]


def stored(request: pb.CreateReferenceRequest) -> pb.Reference:
    reference = pb.Reference()
    reference.CopyFrom(request.reference)
    reference.name = f"{request.scene}/references/{request.reference_id}"
    reference.image_sha256 = hashlib.sha256(request.reference.image).hexdigest()
    reference.ClearField("image")
    return reference


def added(wanted: list[pb.CreateReferenceRequest], answers: list[Any]) -> Played:
    return Played(lambda it: references.add_batch(it, "a", wanted, 10.0, {}), answers, ConnectOptions())


@pytest.mark.parametrize("first", [[], [GONE]], ids=["earlier upload", "lost answer"])
def test_a_batch_that_is_there_is_found_by_one_call(first: list[Any]) -> None:
    wanted = requests(32)
    played = added(wanted, [*first, TAKEN, pb.ListReferencesResponse(references=map(stored, wanted))])
    assert [it.reference_id for it in played.result] == [it.reference_id for it in wanted]
    assert played.methods == ["BatchCreateReferences"] * (len(first) + 1) + ["ListReferences"]


def test_only_what_the_scene_lacks_is_sent_again() -> None:
    wanted = requests(4)
    pages = [
        pb.ListReferencesResponse(references=[stored(wanted[1])], next_page_token="more"),
        pb.ListReferencesResponse(references=[stored(wanted[3])]),
    ]
    lacked = [wanted[0], wanted[2]]
    played = added(wanted, [TAKEN, *pages, pb.BatchCreateReferencesResponse(references=map(stored, lacked))])
    assert [it.reference_id for it in played.result] == ["r00", "r01", "r02", "r03"]
    _, request = played.calls[-1]
    assert isinstance(request, pb.BatchCreateReferencesRequest)
    assert list(request.requests) == lacked


@pytest.mark.parametrize("is_old", [True, False])
def test_depth_counts_only_where_servers_know_it(is_old: bool) -> None:
    pose = RigidTransform(np.eye(3), np.zeros(3))
    wanted = create_request("scenes/a", NewReference("r", b"1", CAMERA, pose, depth=DepthImage(b"depth", 0.001)))
    there = stored(wanted)
    there.ClearField("depth")
    if is_old:
        there.ClearField("provenance")
        with pytest.warns(IgnoredDepth):
            found = added([wanted], [TAKEN, pb.ListReferencesResponse(references=[there])]).result
        assert [it.reference_id for it in found] == ["r"]
    else:
        error = added([wanted], [TAKEN, pb.ListReferencesResponse(references=[there])]).result
        assert error.message == "reference 'r' exists already, with another depth"


@pytest.mark.parametrize("what", ["photograph", "mask", "intrinsics", "pose"])
def test_a_different_reference_of_the_same_name_is_named(what: str) -> None:
    wanted = requests(3)
    there = [stored(it) for it in wanted]
    if what == "photograph":
        there[2].image_sha256 = "0" * 64
    elif what == "mask":
        there[2].mask_sha256 = "0" * 64
    elif what == "intrinsics":
        there[2].intrinsics.focal_x_px += 1
    else:
        there[2].world_from_camera.translation_m.x += 1e-6
    error = added(wanted, [TAKEN, pb.ListReferencesResponse(references=there)]).result
    assert isinstance(error, AlreadyExists)
    assert error.resource == "scenes/a/references/r02"
    assert error.message == f"reference 'r02' exists already, with another {what}"


def test_a_single_reference_that_differs_is_not_ours() -> None:
    (wanted,) = requests(1)
    there = pb.GetReferenceResponse(reference=stored(wanted))

    def looked_up(outcome: object) -> Any:
        return Played(lambda it: repeats.stored_reference(wanted, it, TAKEN), [outcome], ConnectOptions()).result

    assert looked_up(there).reference_id == "r00"
    assert looked_up(ABSENT) is TAKEN
    there.reference.world_from_camera.translation_m.x += 0.001
    assert looked_up(there) is TAKEN


def test_a_taken_name_that_is_not_listed_is_an_error() -> None:
    assert added(requests(3), [TAKEN, pb.ListReferencesResponse()]).result is TAKEN


def a_pose_that_is_none() -> Any:
    pose = wire.transform_to_message(RigidTransform(np.eye(3), np.zeros(3)))
    pose.translation_m.x = math.nan
    return pose


def localized() -> Message:
    answer = localization_pb.LocalizeResponse()
    answer.localization.world_from_camera.CopyFrom(a_pose_that_is_none())
    answer.diagnostics.request_id = "id-7"
    return answer


def of_35_covariances() -> Message:
    answer = localization_pb.LocalizeResponse()
    answer.localization.world_from_camera.CopyFrom(wire.transform_to_message(RigidTransform(np.eye(3), np.zeros(3))))
    answer.localization.covariance.row_major.extend([0.0] * 35)
    return answer


def of_unequal_columns() -> Message:
    answer = localization_pb.LocalizeResponse()
    answer.rejection.message = "no"
    answer.debug.query_x_px.append(1.0)
    return answer


def before_the_calendar() -> Message:
    answer = localization_pb.LocalizeResponse()
    answer.rejection.message = "no"
    answer.capture_time.seconds = -(10**15)
    return answer


def of_a_rig() -> Message:
    answer = localization_pb.LocalizeRigResponse()
    answer.localization.world_from_rig.CopyFrom(a_pose_that_is_none())
    return answer


def localize(connection: Connection) -> Any:
    return localization.localize(connection, b"photo", CAMERA, "a")


@pytest.mark.parametrize(
    ("ask", "answer"),
    [
        (localize, localized),
        (localize, of_35_covariances),
        (localize, of_unequal_columns),
        (localize, before_the_calendar),
        (lambda it: groups.localize_rig(it, [], "a"), of_a_rig),
        (
            lambda it: references.retrieve_references(it, b"photo", CAMERA, "a"),
            lambda: pb.RetrieveReferencesResponse(references=[pb.RetrievedReference()]),
        ),
        (lambda it: scenes.get_scene(it, "a"), pb.GetSceneResponse),
        (lambda it: references.get_reference(it, "a", "b"), pb.GetReferenceResponse),
        (lambda it: anext(scenes.list_scenes(it)), lambda: pb.ListScenesResponse(scenes=[pb.Scene()])),
    ],
)
def test_an_answer_that_breaks_its_contract_is_a_server_error(
    ask: Callable[[Connection], Any], answer: Callable[[], Message]
) -> None:
    error = Played(ask, [answer()], ConnectOptions()).result
    assert isinstance(error, Internal)
    assert error.reason == "MALFORMED_ANSWER"


def test_the_error_names_field_and_call() -> None:
    error = Played(localize, [localized()], ConnectOptions()).result
    assert (error.field, error.request_id) == ("localization.world_from_camera.translation_m.x", "id-7")
    assert "answer of Localize violates" in error.message


def test_a_lookup_that_breaks_its_contract_is_a_server_error() -> None:
    there = stored(requests(1)[0])
    there.world_from_camera.CopyFrom(a_pose_that_is_none())
    page = pb.ListReferencesResponse(references=[there])
    assert isinstance(added(requests(1), [TAKEN, page]).result, Internal)
