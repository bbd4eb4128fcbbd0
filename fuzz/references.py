"""Request validation: ReferenceService with an engine and a store that check their arguments.

Laws: a refusal names a field that the request has; what the store gets has keys of the caller's tenant and legal ids,
can be written down, and reads back as it was; a page begins after a legal id.
"""

import asyncio
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from datetime import date, datetime, timezone
from functools import cache, partial
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from mapless import wire
from mapless.depth import DepthImage, DepthSensor, depth_to_message
from mapless.geometry import RigidTransform
from mapless.names import check_id
from mapless.scenes import UNCHANGED
from mapless.v1 import geometry_pb2
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Description, Photo
from mapless_server.method.features.views import Features, View
from mapless_server.rpc import Call
from mapless_server.scenes import Choice, Coverage, CoverageVerdict, Narrowing, Viewpoint
from mapless_server.scenes.agreement import Agreement
from mapless_server.scenes.plausibility import contradictions
from mapless_server.security import Principal, SceneKey, key_of, scene_id_of, tenant_of
from mapless_server.services import references as reference_service
from mapless_server.services.messages.references import MAX_PAGE_SIZE
from mapless_server.services.reports import MOST_DAYS, MOST_PERIOD_DAYS, days_from_message
from mapless_server.store import (
    NewReference,
    ReferenceRecord,
    Retirement,
    SceneAttributes,
    SceneRecord,
    adoption,
    codec,
    counts,
    restoring,
    rows,
)
from mapless_server.store.depth_images import decode_depth_image, encode_depth_image
from mapless_server.store.restoring import Restored

from . import messages
from .laws import answered, check_pose, check_received_camera
from .localization import CAMERA, POSE, photograph
from .target import Target

_SERVICE = pb.DESCRIPTOR.services_by_name["ReferenceService"]
METHODS = {GetMessageClass(method.input_type): method.name for method in _SERVICE.methods}
KINDS = tuple(METHODS)
TENANT = "acme"
NOTHING_KNOWN = SceneAttributes()
NO_LABELS: Mapping[str, str] = {}
DEPTH = DepthImage.of_metres(np.full((CAMERA.height_px, CAMERA.width_px), 2.0, np.float32), DepthSensor.STEREO)
_NOW = datetime(2026, 11, 21, tzinfo=timezone.utc)
_VIEW = View(CAMERA, Features(np.ones((2, 2), np.float32), np.ones((2, 4), np.float32), np.ones(2, np.float32)))


class InlineExecutor(ThreadPoolExecutor):
    """Does at once what it is given: no thread is waited for."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _NothingCompared:
    """Scenes of whose references nothing is known."""

    def touch(self, key: SceneKey) -> None:
        check_key(key)

    def changed(self, key: SceneKey) -> None:
        check_key(key)

    def known(self, key: SceneKey) -> Agreement:
        check_key(key)
        return Agreement()


class WatchfulEngine:
    """Finds nothing, and looks at what it is given."""

    options = EngineOptions()
    references = SimpleNamespace(agreements=_NothingCompared(), pending=lambda key: ())

    def forget_scene(self, key: SceneKey) -> None:
        check_key(key)

    def forget_references(self, keys: Collection[str]) -> None: ...

    def contradictions(
        self, poses: Sequence[RigidTransform], attributes: SceneAttributes, added: Sequence[RigidTransform] = ()
    ) -> list[str]:
        return contradictions(poses, attributes, added)

    async def describe(self, photos: Sequence[Photo], caller: Caller) -> list[Description]:
        for photo in photos:
            check_received_camera(photo.camera)
        return [Description({"sift": _VIEW}, {"vlad": np.ones(4, np.float32)}) for _ in photos]

    async def retrieve(self, key: SceneKey, photo: Photo, count: int, narrowing: Narrowing, caller: Caller) -> Choice:
        check_key(key)
        check_received_camera(photo.camera)
        assert 1 <= count <= reference_service.MAX_RETRIEVED
        return Choice((), "vlad", 1)

    async def audit(self, key: SceneKey, ids: Sequence[str], caller: Caller, are_listed: bool) -> tuple[int, list[Any]]:
        check_key(key)
        assert [check_id(it) for it in ids]
        assert len(set(ids)) == len(ids) <= reference_service.MAX_AUDITS
        return 1, []

    async def check_coverage(self, key: SceneKey, view: Viewpoint, caller: Caller) -> tuple[int, Coverage]:
        check_key(key)
        check_received_camera(view.camera)
        check_pose(view.world_from_camera)
        return 1, Coverage(CoverageVerdict.DOUBTFUL, "", 0, 0.0, None, ())


class WatchfulStore:
    """Has whatever it is asked for, keeps nothing, and looks at what it is given."""

    database = None

    def list_alike(self, key: SceneKey, *_: object) -> list[ReferenceRecord]:
        check_key(key)
        return []

    def get_generation(self, key: SceneKey) -> int:
        check_key(key)
        return 1

    def get_scene(self, key: SceneKey) -> SceneRecord:
        return self.create_scene(key)

    def get_attributes(self, key: SceneKey) -> SceneAttributes:
        return self.create_scene(key).attributes

    def create_scene(
        self, key: SceneKey, attributes: SceneAttributes = NOTHING_KNOWN, labels: Mapping[str, str] = NO_LABELS
    ) -> SceneRecord:
        check_key(key)
        check_labels(labels)
        row = rows.attributes_row(key, attributes)
        owner = rows.attributes_owner(key)
        assert codec.decode_attributes(owner, row["attributes"], row["attributes_sha256"]) == attributes
        return SceneRecord(key, 1, 0, _NOW, attributes, labels)

    def update_scene(self, key: SceneKey, limit: object = None, **changes: Any) -> SceneRecord:
        assert changes
        assert UNCHANGED not in changes.values()
        labels = changes.pop("labels", NO_LABELS)
        return self.create_scene(key, SceneAttributes(**changes), labels)

    def delete_scene(self, key: SceneKey) -> None:
        check_key(key)

    def list_scenes(
        self, tenant: str, count: int, after: str, labels: Mapping[str, str], limit: object
    ) -> list[SceneRecord]:
        assert limit is None
        check_page(count, after)
        check_labels(labels)
        return [self.create_scene(key_of(tenant, f"s{i}")) for i in range(min(count, 3))]

    def add_references(self, key: SceneKey, references: Sequence[NewReference]) -> list[ReferenceRecord]:
        check_key(key)
        assert len({check_id(it.reference_id) for it in references}) == len(references)
        return [_stored(key, it) for it in references]

    def get_reference(self, key: SceneKey, reference_id: str) -> ReferenceRecord:
        check_key(key)
        return _stored(key, NewReference(check_id(reference_id), b"", CAMERA, POSE, {"sift": _VIEW}))

    def read_image_of(self, key: str) -> bytes:
        return b""

    def delete_reference(self, key: SceneKey, reference_id: str) -> None:
        check_key(key)
        check_id(reference_id)

    def list_retirements(self, key: SceneKey, ids: Sequence[str]) -> dict[str, Retirement]:
        check_key(key)
        assert [check_id(it) for it in ids] == list(ids)
        return {}

    def list_references(
        self, key: SceneKey, limit: int, after: str, *, only_adopted: bool = False, only_retired: bool = False
    ) -> list[ReferenceRecord]:
        return [self.get_reference(key, it) for it in self.list_reference_ids(key, limit, after)]

    def list_reference_ids(self, key: SceneKey, limit: int, after: str) -> list[str]:
        check_key(key)
        check_page(limit, after)
        return [f"r{i}" for i in range(min(limit, 3))]


def check_key(key: SceneKey) -> None:
    """It is the key of a scene of the caller's."""
    assert tenant_of(key) == TENANT
    assert key_of(TENANT, check_id(scene_id_of(key))) == key


def check_page(limit: int, after: str) -> None:
    """It is part of a list."""
    assert 2 <= limit <= MAX_PAGE_SIZE + 1
    assert not after or check_id(after)


def check_labels(labels: Mapping[str, str]) -> None:
    """They fit the columns of their table."""
    for name, value in labels.items():
        assert 1 <= len(name) <= 64
        assert 1 <= len(value) <= 128
        assert "\n" not in value


def _stored(key: SceneKey, new: NewReference) -> ReferenceRecord:
    """The record, written down and read."""
    check_pose(new.world_from_camera)
    record = rows.new_record(key, new, _NOW)
    row = rows.reference_row(record)
    camera, pose, provenance = codec.decode_geometry(record.key, row["geometry"], row["geometry_sha256"])
    assert (camera, provenance) == (new.camera, new.provenance)
    assert (pose.matrix() == new.world_from_camera.matrix()).all()
    if new.depth is not None:
        assert decode_depth_image(encode_depth_image(new.depth), record.depth_sha256).sha256 == record.depth_sha256
    return record


def _retire(store: WatchfulStore, key: SceneKey, reference_id: str) -> ReferenceRecord:
    return store.get_reference(key, reference_id)


def _restore(store: WatchfulStore, key: SceneKey, since: datetime | None, place_id: str) -> Restored:
    check_key(key)
    assert since is None or since.tzinfo is not None
    return Restored([check_id(place_id)] if place_id else [], {"old": "its place needs a new survey"})


def _restore_reference(store: WatchfulStore, key: SceneKey, reference_id: str) -> ReferenceRecord:
    return store.get_reference(key, reference_id)


def _report(store: WatchfulStore, key: SceneKey, request: pb.GetSceneReportRequest) -> pb.SceneReport:
    check_key(key)
    days = days_from_message(request, date(2026, 11, 30))
    assert 0 <= days.last - days.first < MOST_DAYS
    assert 1 <= days.per_period <= MOST_PERIOD_DAYS
    return pb.SceneReport()


def _outdated(service: reference_service.ReferenceService, key: SceneKey) -> dict[str, None]:
    check_key(key)
    return {}


def _numbers(database: object, key: SceneKey) -> counts.ReferenceNumbers:
    check_key(key)
    return counts.ReferenceNumbers(2, 1)


_OF_DATABASES: tuple[tuple[Any, str, Any], ...] = (
    (adoption, "retire_by_operator", _retire),
    (counts, "count_references", _numbers),
    (restoring, "restore", _restore),
    (restoring, "restore_reference", _restore_reference),
    (reference_service, "scene_report", _report),
    (reference_service.ReferenceService, "_outdated_places", _outdated),
)
"""Stand-ins for what reads or changes databases beside the store's methods."""


@cache
def _service() -> tuple[reference_service.ReferenceService, asyncio.AbstractEventLoop]:
    engine: Any = WatchfulEngine()
    store: Any = WatchfulStore()
    with patch.object(reference_service, "ThreadPoolExecutor", InlineExecutor):
        service = reference_service.ReferenceService(lambda: engine, store)
    loop = asyncio.new_event_loop()
    loop.set_default_executor(InlineExecutor())
    return service, loop


def check(data: bytes) -> bool:
    """See Target."""
    request = messages.decoded(KINDS, data)
    if request is None:
        return False
    service, loop = _service()
    call = Call("id", 0.0, float("inf"), Principal(TENANT))
    method = getattr(service, METHODS[type(request)])
    with ExitStack() as stack:
        for room, name, stand_in in _OF_DATABASES:
            stack.enter_context(patch.object(room, name, stand_in))
        return _answered(request, method, call, loop)


def _answered(request: Message, method: Any, call: Call, loop: asyncio.AbstractEventLoop) -> bool:
    return answered(request, lambda: loop.run_until_complete(method(request, call)).SerializeToString())


@cache
def seeds() -> tuple[bytes, ...]:
    """A request of every method, with every field."""
    scene, reference = "scenes/hall", "scenes/hall/references/r0"
    photo: dict[str, Any] = {"image": photograph(), "intrinsics": wire.camera_to_message(CAMERA)}
    pose = wire.transform_to_message(POSE)
    down = geometry_pb2.Vector3(z=-1)
    datum = pb.Datum(latitude_deg=48, longitude_deg=11, enu_from_world=geometry_pb2.Quaternion(w=1))
    factors = dict.fromkeys(
        ("position_factor_68", "position_factor_95", "rotation_factor_68", "rotation_factor_95"), 2.0
    )
    calibration = pb.SceneCalibration(
        **factors,
        reference_noise_m=0.01,
        reference_noise_deg=0.1,
        grows_with_gap=True,
        query_count=9,
        features="sift",
        backend="geometric",
        variant=localization_pb.VARIANT_BEST,
        server_version="1",
    )
    policy = pb.AdoptionPolicy(most_per_place=2, min_trust=0.6, max_radius_m=0.1, min_surveyed_share=0.4)
    known = pb.Scene(name=scene, datum=datum, down_in_world=down, calibration=calibration, adoption=policy)
    update = pb.UpdateSceneRequest(scene=known)
    update.update_mask.paths.extend(["datum", "down_in_world", "calibration", "adoption"])
    create = pb.CreateReferenceRequest(
        scene=scene, reference_id="r0", reference=pb.Reference(world_from_camera=pose, **photo)
    )
    deep = pb.CreateReferenceRequest()
    deep.CopyFrom(create)
    deep.reference.depth.CopyFrom(depth_to_message(DEPTH))
    batch = pb.BatchCreateReferencesRequest(scene=scene, requests=[create, create])
    batch.requests[1].reference_id = "r1"
    retrieve = pb.RetrieveReferencesRequest(scene=scene, count=5, **photo)
    retrieve.position_prior.position_m.x, retrieve.position_prior.radius_m = 1.0, 3.0
    retrieve.heading_prior.direction.x, retrieve.heading_prior.max_angle_deg = 1.0, 60.0
    made = (
        pb.CreateSceneRequest(scene_id="hall", datum=datum, down_in_world=down, labels={"site": "a"}, adoption=policy),
        pb.GetSceneRequest(name=scene),
        update,
        pb.ListScenesRequest(page_size=2, page_token=_token(pb.ListScenesRequest(page_size=2))),
        pb.DeleteSceneRequest(name=scene),
        create,
        deep,
        batch,
        pb.GetReferenceRequest(name=reference, include_image=True),
        pb.ListReferencesRequest(
            scene=scene, page_size=2, page_token=_token(pb.ListReferencesRequest(scene=scene, page_size=2))
        ),
        pb.DeleteReferenceRequest(name=reference),
        pb.RetireReferenceRequest(name=reference),
        pb.RestoreReferenceRequest(name=reference),
        pb.RestoreReferencesRequest(scene=scene, place=reference),
        pb.GetSceneReportRequest(scene=scene, first_day="2026-11-02", last_day="2026-11-29", days_per_period=7),
        retrieve,
        pb.AuditSceneRequest(
            scene=scene, page_size=2, page_token=_token(pb.AuditSceneRequest(scene=scene, page_size=2))
        ),
        pb.AuditSceneRequest(scene=scene, references=[reference]),
        pb.CheckCoverageRequest(scene=scene, world_from_camera=pose, intrinsics=photo["intrinsics"]),
    )
    return tuple(messages.encoded(KINDS, it) for it in made)


def _token(request: Any) -> str:
    """Token of the second page."""
    service, loop = _service()
    call = Call("id", 0.0, float("inf"), Principal(TENANT))
    token: str = loop.run_until_complete(getattr(service, METHODS[type(request)])(request, call)).next_page_token
    return token


TARGET = Target(seeds, check, partial(messages.mutate, KINDS), max_bytes=16384)
