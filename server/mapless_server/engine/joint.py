"""The poses of a rig and of a sequence, from the results of the single photographs."""

from collections.abc import Mapping, Sequence

from mapless.geometry import RigidTransform
from mapless_server.method.groups.checks import check_mounting, check_tracking, check_unit, hinted_group
from mapless_server.method.groups.images import GroupImage, PosedImage
from mapless_server.method.groups.rig import RigEstimate, solve_rig
from mapless_server.method.groups.sequence import SequenceEstimate, solve_sequence
from mapless_server.method.groups.trust import supporters_of_group
from mapless_server.method.judge.references import with_contradiction, without_agreement
from mapless_server.method.options import Variant
from mapless_server.method.rejection import Rejection, RejectionReason

from .failures import SceneMadeAnew
from .query import Query, Result


def pose_rig(
    queries: Sequence[Query], results: Sequence[Result], rig_from_camera: Sequence[RigidTransform]
) -> RigEstimate | Rejection:
    """Estimates the pose of the rig that took the photographs, given in order; SceneMadeAnew as `_check_scene`."""
    _check_scene(results)
    found = _rig(queries, results, rig_from_camera)
    return with_contradiction(found, _contradiction(results)) if isinstance(found, Rejection) else found


def pose_sequence(
    queries: Sequence[Query],
    results: Sequence[Result],
    session_from_camera: Sequence[RigidTransform],
    estimate_scale: bool,
) -> SequenceEstimate | Rejection:
    """Estimates the poses of a sequence's frames, in order, in OpenCV's axes; SceneMadeAnew as `_check_scene`."""
    _check_scene(results)
    found = _sequence(queries, results, session_from_camera, estimate_scale)
    return with_contradiction(found, _contradiction(results)) if isinstance(found, Rejection) else found


def _check_scene(results: Sequence[Result]) -> None:
    """Raises SceneMadeAnew unless all photographs were localized in one scene, whose poses meant the same to all."""
    scenes = [(it.scene.create_time_us, it.attributes.world) for it in results]
    if any(it != scenes[0] for it in scenes):
        raise SceneMadeAnew


def _rig(
    queries: Sequence[Query], results: Sequence[Result], rig_from_camera: Sequence[RigidTransform]
) -> RigEstimate | Rejection:
    found = solve_rig(_images(queries, results), rig_from_camera, queries[0].options.coverage)
    if not isinstance(found, Rejection):
        found = check_mounting(found, [result.answer for result in results])
    if isinstance(found, Rejection):
        return _hinted(found, results)
    if disagreement := _disagreement(results, found.matched):
        return disagreement
    poses = {i: found.world_from_rig.compose(it) for i, it in enumerate(rig_from_camera)}
    return _beyond_limits(queries, poses, "images", results[0].attributes.unit) or found


def _sequence(
    queries: Sequence[Query],
    results: Sequence[Result],
    session_from_camera: Sequence[RigidTransform],
    estimate_scale: bool,
) -> SequenceEstimate | Rejection:
    unit = results[0].attributes.unit
    coverage = queries[0].options.coverage
    found = solve_sequence(_images(queries, results), session_from_camera, estimate_scale, coverage, unit)
    if not isinstance(found, Rejection):
        found = check_tracking(found, session_from_camera, unit)
    if not isinstance(found, Rejection) and not estimate_scale:
        found = check_unit(found, session_from_camera, unit)
    if isinstance(found, Rejection):
        return _hinted(found, results, is_sequence=True)
    since = max((jump.after for jump in found.jumps), default=0)
    if disagreement := _disagreement(results, [it for it in found.matched if it.source.image >= since]):
        return disagreement
    poses = {i: pose for i, pose in enumerate(found.world_from_camera) if i >= since}
    return _beyond_limits(queries, poses, "frames", unit) or found


def _contradiction(results: Sequence[Result]) -> str:
    """The sentence that the scene contradicts itself, as soon as one of the photographs knew it; else empty."""
    return next((it.attributes.contradiction for it in results if it.attributes.contradiction), "")


def _disagreement(results: Sequence[Result], matched: Sequence[PosedImage]) -> Rejection | None:
    """Rejects joint poses in a scene that contradicts itself unless references that they rest on agree."""
    return without_agreement(supporters_of_group(matched)) if _contradiction(results) else None


def _beyond_limits(
    queries: Sequence[Query], poses: Mapping[int, RigidTransform], list_name: str, unit: str
) -> Rejection | None:
    """Rejects a group if a photograph's joint pose is beyond a hard limit of its priors."""
    for i, pose in poses.items():
        if contradiction := queries[i].narrowing.contradiction(pose, unit):
            return Rejection(RejectionReason.PRIOR_CONFLICT, f"{list_name}[{i}]: {contradiction}")
    return None


def _images(queries: Sequence[Query], results: Sequence[Result]) -> list[GroupImage]:
    images = []
    for query, result in zip(queries, results, strict=True):
        pipeline = result.tier.pipeline
        match = pipeline.options.match(Variant.BEST, pipeline.matcher.options.guided_similarity)
        images.append(GroupImage(result.answer, match, query.priors, query.options.intrinsics, query.options.shutter))
    return images


def _hinted(rejection: Rejection, results: Sequence[Result], *, is_sequence: bool = False) -> Rejection:
    images = [(result.answer, result.references) for result in results]
    return hinted_group(rejection, images, is_sequence=is_sequence)
