"""The poses of a rig and of a sequence, from what each photograph gave by itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from mapless.geometry import RigidTransform
from mapless_server.method.groups.checks import check_mounting, check_unit, hinted_group
from mapless_server.method.groups.images import GroupImage
from mapless_server.method.groups.rig import RigEstimate, RigOptions, solve_rig
from mapless_server.method.groups.sequence import SequenceEstimate, SequenceOptions, solve_sequence
from mapless_server.method.options import Variant
from mapless_server.method.rejection import Rejection

from .query import Result

Joint = TypeVar("Joint", RigEstimate, SequenceEstimate)


def pose_rig(results: Sequence[Result], rig_from_camera: Sequence[RigidTransform]) -> RigEstimate | Rejection:
    """The pose of the rig that took the photographs, in order."""
    found = solve_rig(_images(results), rig_from_camera, RigOptions())
    if not isinstance(found, Rejection):
        found = check_mounting(found, [result.answer for result in results])
    return _hinted(found, results)


def pose_sequence(
    results: Sequence[Result], session_from_camera: Sequence[RigidTransform], estimate_scale: bool
) -> SequenceEstimate | Rejection:
    """The poses of the frames of a sequence, in order; OpenCV's axes."""
    found = solve_sequence(_images(results), session_from_camera, estimate_scale, SequenceOptions())
    if not isinstance(found, Rejection) and not estimate_scale:
        found = check_unit(found, session_from_camera)
    return _hinted(found, results)


def _images(results: Sequence[Result]) -> list[GroupImage]:
    images = []
    for result in results:
        pipeline = result.tier.pipeline
        match = pipeline.options.match(Variant.BEST, pipeline.matcher.options.guided_similarity)
        images.append(GroupImage(result.answer, match))
    return images


def _hinted(found: Joint | Rejection, results: Sequence[Result]) -> Joint | Rejection:
    if not isinstance(found, Rejection):
        return found
    return hinted_group(found, [(result.answer, result.references) for result in results])
