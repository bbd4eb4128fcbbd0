"""Requests that the services refuse by the field that is wrong, before anything is computed, read or stored."""

import asyncio
import base64
import math
import time
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from google.protobuf.message import Message
from support.images import png_claiming
from support.messages import set_field
from support.servers import CAMERA, PHOTO, localize_request, pose

from mapless import NewReference, RigidTransform, wire
from mapless.requests import create_request
from mapless.v1 import geometry_pb2 as geometry
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import reference_service_pb2 as reference_pb
from mapless.wire import FieldError
from mapless_server.engine.options import EngineOptions
from mapless_server.errors import RequestError
from mapless_server.observability.metrics import Metrics
from mapless_server.rpc import Call
from mapless_server.security import Principal
from mapless_server.services.handlers import Services
from mapless_server.services.localization import LocalizationService
from mapless_server.services.references import ReferenceService
from mapless_server.settings import load_settings
from mapless_server.store import SceneAttributes

NAN, INFINITY = math.nan, math.inf
SCENE, REFERENCE = "scenes/s", "scenes/s/references/r1"
INTRINSICS, AT = wire.camera_to_message(CAMERA), wire.transform_to_message(pose(0.1))
ZERO, LONG = geometry.Quaternion(), geometry.Quaternion(w=1.1)
NO_POSE = geometry.RigidTransform(rotation=ZERO, translation_m=geometry.Vector3())
RIG_IMAGE = pb.RigImage(image=PHOTO, intrinsics=INTRINSICS, rig_from_camera=AT)
FRAME = pb.SequenceFrame(image=PHOTO, intrinsics=INTRINSICS, session_from_camera=AT)
KNOWN = reference_pb.Scene(
    name=SCENE,
    datum=reference_pb.Datum(latitude_deg=47.5, longitude_deg=8.25, height_m=400.0),
    down_in_world=geometry.Vector3(z=-1),
    calibration=reference_pb.SceneCalibration(
        position_factor_68=1,
        position_factor_95=1,
        rotation_factor_68=1,
        rotation_factor_95=1,
        query_count=1,
        variant=pb.VARIANT_BEST,
    ),
)


def new(reference_id: str) -> reference_pb.CreateReferenceRequest:
    return create_request(SCENE, NewReference(reference_id, PHOTO, CAMERA, pose(0.5)))


GOOD: dict[str, Message] = {
    "Localize": localize_request("s"),
    "LocalizeRig": pb.LocalizeRigRequest(scene=SCENE, images=[RIG_IMAGE] * 3),
    "LocalizeSequence": pb.LocalizeSequenceRequest(scene=SCENE, frames=[FRAME] * 3),
    "WatchQueries": pb.WatchQueriesRequest(scene=SCENE),
    "RetrieveReferences": reference_pb.RetrieveReferencesRequest(scene=SCENE, image=PHOTO, intrinsics=INTRINSICS),
    "AuditScene": reference_pb.AuditSceneRequest(scene=SCENE),
    "GetSceneReport": reference_pb.GetSceneReportRequest(scene=SCENE),
    "CheckCoverage": reference_pb.CheckCoverageRequest(scene=SCENE, world_from_camera=AT, intrinsics=INTRINSICS),
    "BatchCreateReferences": reference_pb.BatchCreateReferencesRequest(scene=SCENE, requests=[new("n0"), new("n1")]),
    "CreateReference": new("n"),
    "GetReference": reference_pb.GetReferenceRequest(name=REFERENCE),
    "ListReferences": reference_pb.ListReferencesRequest(scene=SCENE),
    "DeleteReference": reference_pb.DeleteReferenceRequest(name=REFERENCE),
    "RetireReference": reference_pb.RetireReferenceRequest(name=REFERENCE),
    "RestoreReference": reference_pb.RestoreReferenceRequest(name=REFERENCE),
    "RestoreReferences": reference_pb.RestoreReferencesRequest(scene=SCENE),
    "CreateScene": reference_pb.CreateSceneRequest(scene_id="s", datum=KNOWN.datum, down_in_world=KNOWN.down_in_world),
    "GetScene": reference_pb.GetSceneRequest(name=SCENE),
    "UpdateScene": reference_pb.UpdateSceneRequest(
        scene=KNOWN, update_mask={"paths": ["datum", "down_in_world", "calibration"]}
    ),
    "ListScenes": reference_pb.ListScenesRequest(),
    "DeleteScene": reference_pb.DeleteSceneRequest(name=SCENE),
}


def token_of(tenant: str, collection: str) -> str:
    """Token of the page after item r1 of a list."""
    return base64.urlsafe_b64encode(f"{tenant}\n{collection}\nr1".encode()).decode()


def refusal(method: str, request: Message) -> FieldError | RequestError:
    """The error by which a service refuses a request; it has neither queue nor store, so nothing else can happen."""
    engine: Any = SimpleNamespace(options=EngineOptions())
    store: Any = SimpleNamespace(get_attributes=lambda _: SceneAttributes())
    call: Any = SimpleNamespace(principal=Principal("acme"), note=lambda **_: None)
    nothing: Any = None
    localization = LocalizationService(lambda: engine, nothing, store, nothing)
    references = ReferenceService(lambda: engine, store)
    service = localization if hasattr(localization, method) else references
    with pytest.raises((FieldError, RequestError)) as caught:
        asyncio.run(getattr(service, method)(request, call))
    references.close()
    error = caught.value
    assert isinstance(error, FieldError | RequestError)
    return error


def shifted(y_m: float) -> geometry.RigidTransform:
    return wire.transform_to_message(RigidTransform(np.eye(3), np.array([0.0, y_m, 0.0])))


def prior_at(radius_m: float) -> pb.PositionPrior:
    return pb.PositionPrior(position_m=geometry.Vector3(), radius_m=radius_m)


Case = tuple[str, Any] | tuple[str, Any, str]
"""The field that is set, to what, and the field that is refused if it is another one."""

ITEM = "requests[1]"
NEW = f"{ITEM}.reference"
BAD: dict[str, list[Case]] = {
    "Localize": [
        ("image", b""),
        ("image", b"<svg/>" * 30),
        ("image", png_claiming(30_000, 30_000)),
        ("image", PHOTO + bytes(17 * 2**20)),
        ("intrinsics.width_px", 97),
        ("intrinsics.focal_x_px", 0.0),
        ("intrinsics.focal_x_px", NAN),
        ("intrinsics.principal_y_px", INFINITY),
        ("mask", b""),
        ("session_from_camera", NO_POSE, "session_from_camera.rotation"),
        ("position_prior", prior_at(0.0), "position_prior.radius_m"),
        ("capture_time.seconds", 1_700_000_000_000, "capture_time"),
        ("capture_time.nanos", -5, "capture_time"),
        ("scene", None),
        ("scene", "kitchen"),
        ("references", [REFERENCE] * 2, "references[1]"),
        ("references", ["scenes/other/references/r1"], "references[0]"),
        ("references", ["scenes/s/references/a..b"], "references[0]"),
        ("references", ["scenes/s/references/../../etc/passwd"], "references[0]"),
        ("references", ["scenes/s/references/" + "x" * 10_000], "references[0]"),
        ("references", [f"scenes/s/references/r{i}" for i in range(65)]),
        ("options.variant", 77),
        ("options.scale_strategy", -1),
        ("options.reference_count", 65),
        ("options.reference_count", -1),
    ],
    "LocalizeRig": [
        ("images", None),
        ("images", [RIG_IMAGE] * 6),
        ("images[1].rig_from_camera", None),
        ("capture_time.seconds", 1_700_000_000_000_000_000, "capture_time"),
        ("images[2].rig_from_camera.translation_m.y", NAN),
        ("images[2].rig_from_camera.translation_m.y", 1e8),
        ("images[0].rig_from_camera.rotation", ZERO),
        ("images[2].intrinsics.width_px", 97),
        ("images[1].image", b"<svg/>"),
        ("images[1].mask", b""),
        ("images[1].references", ["scenes/other/references/r1"], "images[1].references[0]"),
        ("images[1].intrinsics_uncertainty.readout_s", 10.0),
        ("images[1].heading_prior", pb.HeadingPrior(), "images[1].heading_prior.direction"),
        ("images[2].geo_position_prior", pb.GeoPositionPrior(horizontal_sigma_m=1.0)),
        ("options.variant", pb.VARIANT_FULL),
        ("options.reference_count", 65),
        ("scene", None),
        ("session_from_rig", shifted(NAN), "session_from_rig.translation_m.y"),
        ("options.axes", pb.AXES_UNITY),
        ("options.axes", 77),
    ],
    "LocalizeSequence": [
        ("frames", [FRAME] * 14),
        ("frames[1].session_from_camera", None),
        ("frames[1].session_from_camera.rotation.w", NAN, "frames[1].session_from_camera.rotation"),
        ("options.axes", 77),
        ("frames[2].intrinsics.width_px", 97),
        ("frames[2].mask", b""),
        ("frames[2].intrinsics_uncertainty.readout_s", NAN),
        ("frames[0].intrinsics_uncertainty.turn_deg_per_s", 90.0),
        ("frames[1].capture_time.seconds", 1_700_000_000_000, "frames[1].capture_time"),
    ],
    "WatchQueries": [("scene", "hall")],
    "RetrieveReferences": [
        ("count", -1),
        ("count", 1001),
        ("position_prior", prior_at(-1.0), "position_prior.radius_m"),
        ("intrinsics.width_px", 97),
        ("image", b"no image"),
        ("mask", b""),
    ],
    "AuditScene": [
        ("page_size", -1),
        ("page_token", token_of("acme", SCENE)),
        ("page_token", token_of("other", f"{SCENE} audit")),
        ("references", [REFERENCE] * 2, "references[1]"),
    ],
    "CheckCoverage": [("world_from_camera", None), ("intrinsics", None)],
    "BatchCreateReferences": [
        ("requests", None),
        ("requests", [new(f"x{i}") for i in range(999)]),
        (f"{ITEM}.reference_id", None),
        (f"{ITEM}.reference_id", "a..b"),
        (f"{ITEM}.reference_id", "a/b"),
        (f"{ITEM}.reference_id", "x" * 10_000),
        (f"{ITEM}.reference_id", "n0"),
        (f"{ITEM}.scene", "scenes/other"),
        (NEW, None),
        (f"{NEW}.image", None),
        (f"{NEW}.intrinsics.height_px", 65, f"{NEW}.intrinsics.width_px"),
        (f"{NEW}.world_from_camera", None),
        (f"{NEW}.world_from_camera.rotation", ZERO),
        (f"{NEW}.world_from_camera.rotation", LONG),
        (f"{NEW}.world_from_camera.translation_m.y", 1.1e7),
    ],
    "CreateReference": [("scene", "s"), ("reference_id", ".."), ("reference.mask", b"")],
    "GetReference": [("name", SCENE), ("name", "scenes/../references/x")],
    "ListReferences": [
        ("scene", REFERENCE),
        ("page_size", -1),
        *(("page_token", it) for it in ("r1", "€", token_of("other", SCENE), token_of("acme", "scenes"))),
        *(("page_token", token_of("acme", it)) for it in ("scenes/t", f"{SCENE} audit")),
    ],
    "DeleteReference": [("name", "scenes/../references/x")],
    "RetireReference": [("name", "scenes/../references/x")],
    "RestoreReference": [("name", "scenes/../references/x")],
    "RestoreReferences": [
        ("scene", "s"),
        ("place", "x"),
        ("place", "scenes/other/references/x"),
        ("since.nanos", -1, "since"),
    ],
    "GetSceneReport": [("scene", "s"), ("first_day", "today"), ("last_day", "2026-13-01"), ("days_per_period", 367)],
    "CreateScene": [
        ("scene_id", ".."),
        ("datum.latitude_deg", 91.0),
        ("down_in_world", geometry.Vector3(x=INFINITY)),
    ],
    "GetScene": [("name", "scenes/..")],
    "UpdateScene": [
        ("scene.name", None),
        *(("update_mask.paths", [it], "update_mask") for it in ("name", "datum.latitude_deg", "*", "", "x" * 10_000)),
        ("update_mask", None),
        ("scene.datum.latitude_deg", 90.001),
        ("scene.datum.latitude_deg", NAN),
        ("scene.datum.longitude_deg", -181),
        ("scene.datum.height_m", INFINITY),
        ("scene.datum.height_m", -12_001),
        ("scene.datum.enu_from_world", ZERO),
        ("scene.datum.enu_from_world", LONG),
        ("scene.datum.enu_from_world", geometry.Quaternion(w=NAN)),
        ("scene.down_in_world.z", 0.0, "scene.down_in_world"),
        ("scene.down_in_world.x", NAN, "scene.down_in_world"),
        ("scene.calibration.variant", pb.VARIANT_UNSPECIFIED),
        ("scene.calibration.variant", 99),
        ("scene.calibration.position_factor_68", 0),
        ("scene.calibration.position_factor_95", NAN),
        ("scene.calibration.rotation_factor_68", 1001),
        ("scene.calibration.rotation_factor_95", -1),
        ("scene.calibration.query_count", 0),
        ("scene.calibration.reference_noise_m", -1),
        ("scene.calibration.reference_noise_deg", INFINITY),
        ("scene.calibration.backend", "x" * 129),
    ],
    "ListScenes": [("page_size", -1), *(("page_token", token_of("acme", it)) for it in (SCENE, f"{SCENE} audit"))],
    "DeleteScene": [("name", REFERENCE)],
}
CASES = [(method, case) for method, cases in BAD.items() for case in cases]


def test_every_method_is_asked() -> None:
    services = (pb.DESCRIPTOR.services_by_name, reference_pb.DESCRIPTOR.services_by_name)
    named = {method.name for service in services for it in service.values() for method in it.methods}
    assert named - {"LocalizeProgressively"} == BAD.keys() == GOOD.keys()


@pytest.mark.parametrize(("method", "case"), CASES, ids=[f"{i}-{it[0]}-{it[1][0]}" for i, it in enumerate(CASES)])
def test_a_wrong_field_is_refused_by_its_name(method: str, case: Case) -> None:
    path, value, *other = case
    request = type(GOOD[method])()
    request.CopyFrom(GOOD[method])
    set_field(request, path, value)
    error = refusal(method, request)
    assert error.field == (*other, path)[0]
    assert len(str(error)) <= 1000


def test_a_single_frame_is_no_sequence() -> None:
    assert refusal("LocalizeSequence", pb.LocalizeSequenceRequest(scene=SCENE, frames=[FRAME])).field == "frames"


@pytest.mark.parametrize(
    ("method", "is_refused"), [("LocalizationService/Localize", True), ("ReferenceService/GetScene", False)]
)
async def test_no_photograph_is_read_with_no_time_left(method: str, is_refused: bool) -> None:
    """Other methods may take a millisecond."""
    services = Services(load_settings({}, None).settings, cast(Any, None), Metrics())
    services._engine = cast(Any, SimpleNamespace(check_room=lambda *_: None))
    now_s = time.monotonic()
    services._check_admission(f"/mapless.v1.{method}", Call("id", now_s, now_s + 1.0))
    hurried = Call("id", now_s, now_s + 0.001)
    if not is_refused:
        services._check_admission(f"/mapless.v1.{method}", hurried)
        return
    with pytest.raises(RequestError) as caught:
        services._check_admission(f"/mapless.v1.{method}", hurried)
    assert (caught.value.code, caught.value.reason) == ("DEADLINE_EXCEEDED", "DEADLINE_INFEASIBLE")
