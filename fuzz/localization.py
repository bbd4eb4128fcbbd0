"""Request validation: the requests of LocalizationService up to the values that the engine gets.

Laws: a refusal names a field that the request has; what is accepted is finite, orthonormal, positive definite and of
unit length where its type says so, survives the wire, and can be computed with.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import numpy as np

from mapless import wire
from mapless.geodesy import Datum
from mapless.geometry import MAX_COORDINATE_M, Camera, Quaternion, RigidTransform, rotation_from_vector
from mapless.names import check_id
from mapless.v1 import geometry_pb2
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.groups import MAX_FRAMES, MAX_RIG_IMAGES, MIN_FRAMES
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Query, SceneQuestion
from mapless_server.images import image_size
from mapless_server.method.bundle.priors import DirectionPrior, PosePrior, PositionPrior, Prior
from mapless_server.security import key_of, scene_id_of, tenant_of
from mapless_server.services.messages.answers import MAX_SESSION_COORDINATE_M, answer_frames_of, set_frames
from mapless_server.services.messages.groups import (
    poses_from_message,
    queries_from_message,
    session_from_rig_from_message,
    session_poses_from_message,
)
from mapless_server.services.messages.priors import needs_attributes
from mapless_server.services.messages.queries import (
    MAX_CANDIDATES,
    MAX_REFERENCES,
    query_among,
    query_from_message,
)
from mapless_server.services.messages.references import labels_from_message
from mapless_server.services.messages.scenes import (
    FoundScenes,
    names_several,
    questions_from_message,
    scene_keys_from_message,
)
from mapless_server.store import GroupedScene, SceneAttributes

from . import messages
from .images import seeds as image_seeds
from .laws import answered, check_covariance, check_pose, check_received_camera, check_unit
from .target import Target

KINDS = (pb.LocalizeRequest, pb.LocalizeRigRequest, pb.LocalizeSequenceRequest, pb.WatchQueriesRequest)
ENGINE = EngineOptions()
TENANT = "acme"
KNOWN = SceneAttributes(Datum(48.1, 11.6, 520.0, Quaternion(0.5, -0.5, -0.5, 0.5)))
"""Attributes of the scene that requests name."""

KINDS_OF_SCENES = (
    KNOWN,
    SceneAttributes(Datum(-33.9, 151.2, 40.0)),
    SceneAttributes(down_in_world=(0.0, 1.0, 0.0)),
    SceneAttributes(arbitrary_unit=True),
)
FURTHEST_M = 10 * MAX_COORDINATE_M
"""Coordinates in the world of a scene of what is given in that of another, on the other side of the Earth."""

CAMERA = Camera(32, 33, 30.0, 31.0, 15.5, 16.25)
POSE = RigidTransform(rotation_from_vector([0.2, -0.7, 0.15]), np.array([1.5, -0.25, 2.0]))
_ROOT = np.full((6, 6), 0.01) + np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
COVARIANCE = _ROOT @ _ROOT.T


def check(data: bytes) -> bool:
    """See Target."""
    request: Any = messages.decoded(KINDS, data)
    if request is None:
        return False
    return answered(request, lambda: _CHECKS[type(request)](request))


def _check_localize(request: pb.LocalizeRequest) -> None:
    addressee = answer_frames_of(request)
    if names_several(request):
        _check_among(request)
        return
    attributes = KNOWN if needs_attributes(request) else SceneAttributes()
    query = query_from_message(request, TENANT, ENGINE, attributes)
    _check_query(query, [request.scene])
    if addressee.session_from_camera is not None:
        check_pose(addressee.session_from_camera, MAX_SESSION_COORDINATE_M)
    answer = pb.Localization()
    set_frames(answer, POSE, COVARIANCE, addressee.axes, addressee.session_from_camera, attributes.datum)
    _check_finite(answer)


def _check_among(request: pb.LocalizeRequest) -> None:
    """Among the scenes that a request lists, which exist, or those of a group; of all kinds by turns."""
    keys = scene_keys_from_message(request, TENANT) if request.scenes else [key_of(TENANT, it) for it in "abcdef"]
    labels_from_message(request.scene_group.labels, "scene_group.labels")
    scenes = [
        GroupedScene(1, 0, partial(KINDS_OF_SCENES.__getitem__, i % len(KINDS_OF_SCENES)), key)
        for i, key in enumerate(keys)
    ]
    found = questions_from_message(request, FoundScenes(scenes), TENANT, lambda _: np.ones(len(keys)))
    for it in () if found.beyond is None else found.beyond():
        assert it.scene_key in keys
    query = query_among(request, ENGINE, found.questions, found.prior_scene)
    asked = query.scenes or [SceneQuestion(query.scene_key, query.narrowing, query.priors)]
    assert {it.scene_key for it in asked} <= set(keys)
    assert len({it.scene_key for it in asked}) == len(asked) >= 1
    for it in asked:
        _check_query(query.in_scene(it), [f"scenes/{scene_id_of(it.scene_key)}"], FURTHEST_M)


def _check_rig(request: pb.LocalizeRigRequest) -> None:
    queries = queries_from_message(request, "images", (1, MAX_RIG_IMAGES), TENANT, ENGINE, KNOWN)
    poses = poses_from_message(request.images, "images", "rig_from_camera")
    session_from_rig = session_from_rig_from_message(request)
    assert 1 <= len(queries) == len(poses) <= MAX_RIG_IMAGES
    for query in queries:
        _check_query(query, [request.scene])
    for pose in poses if session_from_rig is None else (*poses, session_from_rig):
        check_pose(pose, MAX_SESSION_COORDINATE_M)


def _check_sequence(request: pb.LocalizeSequenceRequest) -> None:
    queries = queries_from_message(request, "frames", (MIN_FRAMES, MAX_FRAMES), TENANT, ENGINE, KNOWN)
    _, poses = session_poses_from_message(request)
    assert MIN_FRAMES <= len(queries) == len(poses) <= MAX_FRAMES
    for query in queries:
        _check_query(query, [request.scene])
    for pose in poses:
        check_pose(pose, MAX_SESSION_COORDINATE_M)


def _check_watch(request: pb.WatchQueriesRequest) -> None:
    assert request.scene == f"scenes/{check_id(wire.scene_id_from_name(request.scene, 'scene'))}"


_CHECKS: dict[type, Any] = dict(zip(KINDS, (_check_localize, _check_rig, _check_sequence, _check_watch), strict=True))


def _check_query(query: Query, names: Sequence[str], furthest_m: float = MAX_COORDINATE_M) -> None:
    assert tenant_of(query.scene_key) == TENANT
    assert names == [f"scenes/{check_id(scene_id_of(query.scene_key))}"]
    assert len(set(query.reference_ids)) == len(query.reference_ids)
    assert len(query.reference_ids) <= (MAX_CANDIDATES if query.rerank else MAX_REFERENCES)
    assert all(check_id(it) for it in query.reference_ids)
    assert 1 <= query.reference_count <= MAX_REFERENCES
    assert 0 < query.options.coverage < 1
    check_received_camera(query.photo.camera)
    size = image_size(query.photo.image, ENGINE.image_limits)
    assert size == (query.photo.camera.width_px, query.photo.camera.height_px)
    for prior in query.priors:
        _check_prior(prior, furthest_m)
    narrowing = query.narrowing
    if narrowing.position is not None:
        assert np.abs(narrowing.position.position).max() <= furthest_m
        assert 0 < narrowing.position.radius_m < np.inf
    centres = np.array([POSE.translation, [1e7, -1e7, 0.0]])
    for place in (narrowing.position, *narrowing.likely_positions):
        assert place is None or place.keeps(centres, narrowing.margin_m).dtype == bool
    for cone in (narrowing.heading, *narrowing.likely_headings):
        if cone is not None:
            check_unit(cone.forward)
            assert cone.keeps(np.eye(3), narrowing.margin_deg).shape == (3,)


def _check_prior(prior: Prior, furthest_m: float) -> None:
    if isinstance(prior, PositionPrior | PosePrior):
        check_covariance(prior.covariance, 3 if isinstance(prior, PositionPrior) else 6)
    if isinstance(prior, PositionPrior):
        assert np.isfinite(prior.position).all()
    if isinstance(prior, PosePrior):
        check_pose(prior.world_from_camera, furthest_m)
    if isinstance(prior, DirectionPrior):
        check_unit(prior.in_camera)
        check_unit(prior.in_world)
    term = prior.term(POSE)
    gradient, information = term.gradient_and_information()
    assert np.isfinite(gradient).all()
    assert np.isfinite(information).all()
    assert term.squared_distance(COVARIANCE) >= 0
    assert np.isfinite(term.relative_information(COVARIANCE))


def _check_finite(message: Any) -> None:
    for field, value in message.ListFields():
        if field.message_type is not None:
            _check_finite(value)
        elif field.cpp_type == field.CPPTYPE_DOUBLE:
            assert np.isfinite(value).all(), (message.DESCRIPTOR.name, field.name)


@cache
def seeds() -> tuple[bytes, ...]:
    """Requests of every kind, and one with every field."""
    photo: dict[str, Any] = {"image": photograph(), "intrinsics": wire.camera_to_message(CAMERA)}
    pose = wire.transform_to_message(POSE)
    names = [f"scenes/hall/references/r{i}" for i in range(3)]
    plain = pb.LocalizeRequest(scene="scenes/hall", **photo)
    named = pb.LocalizeRequest(scene="scenes/hall", references=names, session_from_camera=pose, **photo)
    named.options.rerank_references = True
    named.options.axes = pb.AXES_UNITY
    named.intrinsics.fisheye.k1 = 0.1
    full = pb.LocalizeRequest(scene="scenes/hall", **photo)
    full.intrinsics.radial_tangential.k1 = 0.1
    full.geo_position_prior.CopyFrom(
        pb.GeoPositionPrior(
            latitude_deg=48.1, longitude_deg=11.6, height_m=520, horizontal_sigma_m=5, vertical_sigma_m=9
        )
    )
    full.gravity_prior.CopyFrom(pb.GravityPrior(down_in_camera=geometry_pb2.Vector3(y=1), sigma_deg=2))
    full.heading_prior.CopyFrom(pb.HeadingPrior(direction=geometry_pb2.Vector3(x=1), max_angle_deg=60, sigma_deg=20))
    full.pose_prior.world_from_camera.CopyFrom(pose)
    full.pose_prior.covariance.row_major.extend(COVARIANCE.ravel().tolist())
    full.options.coverage = 0.9
    near = pb.LocalizeRequest(scene="scenes/hall", **photo)
    near.position_prior.CopyFrom(
        pb.PositionPrior(position_m=geometry_pb2.Vector3(x=1), radius_m=3, covariance_m2=COVARIANCE[:3, :3].ravel())
    )
    listed = pb.LocalizeRequest(scenes=["scenes/a", "scenes/b", "scenes/c"], prior_scene="scenes/b", **photo)
    group = pb.LocalizeRequest(prior_scene="scenes/a", **photo)
    group.scene_group.labels["site"] = "a"
    for among, with_priors in ((listed, near), (group, full)):
        for field, value in with_priors.ListFields():
            if field.name.endswith("_prior"):
                getattr(among, field.name).CopyFrom(value)
    rig = pb.LocalizeRigRequest(scene="scenes/hall", session_from_rig=pose)
    sequence = pb.LocalizeSequenceRequest(scene="scenes/hall")
    for _ in range(3):
        rig.images.add(rig_from_camera=pose, references=names, **photo)
        sequence.frames.add(session_from_camera=pose, **photo)
    made = (plain, named, full, near, listed, group, rig, sequence, pb.WatchQueriesRequest(scene="scenes/hall"))
    return tuple(messages.encoded(KINDS, it) for it in made)


def photograph() -> bytes:
    """The smallest that CAMERA may have taken."""
    return min((it for it in image_seeds() if image_size(it, ENGINE.image_limits) == (32, 33)), key=len)


TARGET = Target(seeds, check, partial(messages.mutate, KINDS), max_bytes=16384)
