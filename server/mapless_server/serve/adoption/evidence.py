"""The part of an answer that adoption uses: its pose, radii and matches."""

from dataclasses import replace

import numpy as np

from mapless.geometry import Array
from mapless.names import parse_reference_name
from mapless.provenance import ADOPTED
from mapless.scenes import AdoptionPolicy
from mapless_server.engine.group_cameras import read_with
from mapless_server.engine.query import DEFAULT_REFERENCE_COUNT, Query, Result
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.bundle.intrinsics import DOUBTED_SIGMAS
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pose.pnp import MIN_MATCHES, PnpOptions, ransac
from mapless_server.scenes.adoption.policy import Evidence, camera_error_m
from mapless_server.services.messages.answers import radii_of, used_camera
from mapless_server.services.messages.debug import sent_pixels

RIVALS = PnpOptions(max_iterations=2000)
"""As the pose itself, but rare rivals need not be found: so many iterations find one that 15 % of matches agree on."""


def evidence_of(query: Query, result: Result) -> Evidence | None:
    """The evidence of a result, with the radii that are reported; None for a rejection, or a pose without radii."""
    answer, outcome = result.answer, result.answer.outcome
    if not isinstance(outcome, Localization) or outcome.covariance is None:
        return None
    ids = [parse_reference_name(it.name)[1] for it in result.references]
    counts = zip(ids, answer.reference_inlier_counts, strict=True)
    reported = radii_of(result, query.options, outcome.covariance)
    radii = reported.accuracy
    return Evidence(
        outcome.world_from_camera,
        radii.position_68_m,
        radii.position_95_m,
        radii.rotation_68_deg,
        radii.rotation_95_deg,
        outcome.trust or 0.0,
        outcome.inlier_count,
        {name: count for name, count in counts if count},
        reported.covariance,
    )


def has_its_camera(query: Query, result: Result) -> bool:
    """Whether the matches of a kept photograph show no other camera than it is kept with.

    They do where its pose is with a camera that they correct, and where they show an error that is significant by what
    this photograph alone says: its pose takes such an error up, but the reference would keep it.
    """
    camera, support = used_camera(result, query.options, query.photo), result.answer.support
    if camera is None or camera.camera != query.photo.camera or not isinstance(support, PosedSupport):
        return False
    found = support.estimate.intrinsics
    return found is None or bool((np.abs(found.value) <= DOUBTED_SIGMAS * found.sigma).all())


def kept_query(query: Query, result: Result, policy: AdoptionPolicy, coverage: float) -> Query | None:
    """The query as it is asked again: in the scene of its answer alone, and as references are used.

    These have the camera that is stated, or that the answer reports, a global shutter, and no depth. What else the
    caller chose, as fewer references or radii that the scene does not calibrate, counts for its answer alone;
    `coverage` is the server's. None where an estimated camera is not known well enough for the policy.
    """
    assert result.scene_key is not None
    kept = replace(
        query,
        photo=replace(query.photo, depth=None),
        scene_key=result.scene_key,
        scenes=(),
        is_part=False,
        reference_count=DEFAULT_REFERENCE_COUNT,
        options=LocalizeOptions(coverage=coverage),
        is_generic=False,
    )
    if query.photo.exif is None:
        return kept
    camera = used_camera(result, query.options, query.photo)
    if camera is None or camera.sigma is None:
        return None
    error_m = camera_error_m(camera.camera, camera.sigma.focal_share, distance_shown(result))
    return read_with(kept, camera) if error_m <= policy.radius_m else None


def with_stated_camera(kept: Query, query: Query) -> Query:
    """A kept query with the uncertainty of the camera and the shutter that its call stated; itself without any."""
    stated = replace(kept.options, intrinsics=query.options.intrinsics, shutter=query.options.shutter)
    return kept if query.photo.exif is not None or stated == kept.options else replace(kept, options=stated)


def is_by_survey(result: Result) -> bool:
    """Whether no adopted reference has part in an answer."""
    support = result.answer.support
    if not isinstance(support, PosedSupport):
        return False
    counts = zip(support.references, support.inliers_by_reference(), strict=True)
    return not any(count and it.provenance.source == ADOPTED for it, count in counts)


def shares_compared(found: Evidence, result: Result) -> dict[str, float]:
    """Share of a photograph's matches with each reference that it was compared with, by id."""
    ids = (parse_reference_name(it.name)[1] for it in result.references)
    return {it: found.inliers_of.get(it, 0) / max(found.inlier_count, 1) for it in ids}


def inliers_px(result: Result) -> Array:
    """The keypoints (M, 2) of the matches that agree with a pose, pixels of the photograph as it was sent."""
    support = result.answer.support
    return inliers_of(support) if isinstance(support, PosedSupport) else np.empty((0, 2))


def inliers_of(support: PosedSupport) -> Array:
    """The keypoints (M, 2) of the matches that agree with an estimate, see `inliers_px`."""
    keypoints = support.matches.keypoint[support.estimate.inliers]
    if support.two_view is not None:
        keypoints = np.concatenate([keypoints, support.two_view.keypoint[support.two_view.inliers]])
    return sent_pixels(support.query, support.query.features.keypoints[keypoints])


def keypoints_px(result: Result) -> Array:
    """All keypoints (K, 2) of a photograph, pixels of it as it was sent."""
    support = result.answer.support
    return np.empty((0, 2)) if support is None else sent_pixels(support.query, support.query.features.keypoints)


def rival_count(result: Result) -> int:
    """Number of matches that the pose does not explain and that agree on another one; 0 without a pose."""
    support = result.answer.support
    return rivals_of(support) if isinstance(support, PosedSupport) else 0


def rivals_of(support: PosedSupport) -> int:
    """Number of matches that an estimate does not explain and that agree on another pose, see `rival_count`.

    Those that were searched near its own projections are left out.
    """
    unexplained = support.matches.select(~support.matches.guided & ~support.estimate.inliers)
    if len(unexplained) < MIN_MATCHES:
        return 0
    seen = unexplained.seen(support.query, support.structure.x_in_world)
    pose = ransac(seen, None, RIVALS)
    return 0 if pose is None else seen.inlier_count(pose, RIVALS.inlier_px)


def distance_shown(result: Result) -> float:
    """Median distance of the points that agree with a pose along its optical axis, metres; 0 without any."""
    support = result.answer.support
    if not isinstance(support, PosedSupport) or not support.estimate.inliers.any():
        return 0.0
    points = support.structure.x_in_world[support.matches.point[support.estimate.inliers]]
    pose = support.estimate.world_from_camera
    return float(np.median(pose.inverse().apply(points)[:, 2]))
