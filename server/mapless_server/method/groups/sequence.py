"""The poses of a short sequence: photographs of one camera with the poses that the device tracked.

Three steps: an initial world_from_session, from the photographs localized alone or from the matches of all (generalized
PnP, the whole sequence as one camera); from it a pose of every frame, continued by tracking from the frames with
consistent poses of their own; and a joint adjustment with a robust cost on the tracked steps (see `drift`).

So drift does not affect frames with good matches, and accurate tracking poses those without.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse.csgraph import connected_components

from mapless.geometry import Array, RigidTransform, Similarity, rotation_angle_deg

from ..options import check_bounds
from ..pnp import PnpOptions
from ..rejection import Rejection, RejectionReason
from .drift import DriftOptions, SequenceState, world_from_session_at
from .generalized import CameraMatches, inlier_count, rig_ransac, scaled_ransac
from .images import (
    GroupGateOptions,
    GroupImage,
    MatchedImage,
    PosedImage,
    group_gate_failure,
    matched_images_of,
    rejection_without_matches,
)
from .joint import JointEstimate, JointOptions, adjust_in_rounds, covariance_in_world


@dataclass(frozen=True)
class SequenceOptions:
    """Options of posing a sequence.

    Attributes:
        pnp: of the pose solvers; `min_matches` of all frames together.
        gate: of the gate, on the sums over the frames.
        joint: of the adjustment.
        drift: of the session.
        rounds: of searching matches and adjusting; the second starts from better poses.
        loose_px: inlier bound for initial guesses, which drift.
        enough_share: share of inliers with which a guess from single frames is used without generalized PnP.
        same_position_m, same_rotation_deg: two frames' own poses are consistent with the session within this plus three
            standard deviations of the drift.
        min_motion: least extent of a session of unknown unit, as a share of its distance from its own origin; less is
            rounding.
        max_scale_sigma: largest relative standard deviation of an accepted scale.
        scale_iterations: samples of the RANSAC for pose and scale.
        scale_matches: matches on which they are scored.
    """

    pnp: PnpOptions = field(default_factory=PnpOptions)
    gate: GroupGateOptions = field(default_factory=GroupGateOptions)
    joint: JointOptions = field(default_factory=JointOptions)
    drift: DriftOptions = field(default_factory=DriftOptions)
    rounds: int = 2
    loose_px: float = 12.0
    enough_share: float = 0.5
    same_position_m: float = 0.1
    same_rotation_deg: float = 2.0
    min_motion: float = 1e-6
    max_scale_sigma: float = 0.15
    scale_iterations: int = 1000
    scale_matches: int = 600

    def __post_init__(self) -> None:
        check_bounds(self, "rounds scale_iterations scale_matches", at_least=1)
        check_bounds(self, "loose_px enough_share same_position_m same_rotation_deg", above=0)
        check_bounds(self, "min_motion max_scale_sigma", above=0)


@dataclass(frozen=True, eq=False)
class SequenceEstimate:
    """The estimated poses of a sequence.

    Attributes:
        world_from_session: as it is at the last frame, metres from the session's unit.
        scale_sigma: relative standard deviation of its scale; 0 where the session is metric.
        world_from_camera: of every frame, metric, drift taken out.
        covariances: (F, 6, 6) of the same, order x y z rx ry rz, fixed world axes, metres and radians.
        matched: the frames that have matches, in order.
        origin: (3,) of the world in which these are, metres; the poses are in the caller's.
    """

    world_from_session: Similarity
    scale_sigma: float
    world_from_camera: tuple[RigidTransform, ...]
    covariances: Array
    matched: tuple[PosedImage, ...]
    origin: Array


def solve_sequence(
    images: Sequence[GroupImage],
    session_from_camera: Sequence[RigidTransform],
    estimate_scale: bool,
    options: SequenceOptions,
) -> SequenceEstimate | Rejection:
    """The poses of a sequence.

    Args:
        images: the frames in the order they were taken, with their own answers.
        session_from_camera: the tracked pose of each.
        estimate_scale: whether the unit of the session is unknown; else it is the metre.
        options: of the sequence.

    Returns:
        The estimate. Rejections: that of the frame that reached the latest stage, if none has matches; TOO_FEW_MATCHES;
        PNP_FAILED if no poses have four inliers; SCALE_UNRELIABLE if the scale is unknown and the session moves too
        little to determine it; GATE.
    """
    origin, matched_images = matched_images_of(images)
    if not matched_images:
        return rejection_without_matches(images)
    session = _Session(tuple(session_from_camera), estimate_scale, options)
    if estimate_scale and not session.moves:
        return Rejection(RejectionReason.SCALE_UNRELIABLE, "the session does not move: its unit cannot be determined")
    total = sum(len(it.tracked) for it in matched_images)
    if total < options.pnp.min_matches:
        message = f"{total} 2D-3D matches in {len(matched_images)} frames, {options.pnp.min_matches} needed"
        return Rejection(RejectionReason.TOO_FEW_MATCHES, message)
    guess = session.first_guess(matched_images)
    if guess is None:
        return Rejection(RejectionReason.PNP_FAILED, f"no poses of the sequence explain four of {total} matches")
    poses = session.poses(matched_images, guess)
    state = SequenceState.of(poses, session_from_camera, guess.scale, estimate_scale, options.drift)
    estimate = adjust_in_rounds(matched_images, state, options.joint, options.rounds)
    return _rejection(estimate, options) or _result(estimate, session.frames, origin)


def _rejection(estimate: JointEstimate[SequenceState], options: SequenceOptions) -> Rejection | None:
    if estimate.inlier_count < 4:
        return Rejection(RejectionReason.PNP_FAILED, "no poses of the sequence explain four matches")
    failure = group_gate_failure(estimate.matched, options.pnp.inlier_px, options.gate)
    if failure:
        return Rejection(RejectionReason.GATE, failure)
    sigma = _scale_sigma(estimate)
    if not sigma <= options.max_scale_sigma:
        message = f"the session moves too little for its unit: the scale is known to {100 * sigma:.0f} % only"
        return Rejection(RejectionReason.SCALE_UNRELIABLE, message)
    return None


def _scale_sigma(estimate: JointEstimate[SequenceState]) -> float:
    return math.sqrt(estimate.covariance[-1, -1]) if estimate.state.scale_is_free else 0.0


def _result(
    estimate: JointEstimate[SequenceState], session: Sequence[RigidTransform], origin: Array
) -> SequenceEstimate:
    state = estimate.state
    poses = [frame.inverse() for frame in state.frames]
    blocks = (estimate.covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] for i in range(len(poses)))
    last = world_from_session_at(poses[-1], session[-1], state.scale)
    return SequenceEstimate(
        replace(last, translation=last.translation + origin),
        _scale_sigma(estimate),
        tuple(pose.shifted(origin) for pose in poses),
        np.array([covariance_in_world(block, pose) for block, pose in zip(blocks, poses, strict=True)]),
        estimate.matched,
        origin,
    )


@dataclass(frozen=True, eq=False)
class _Session:
    """The tracked session, and initial poses from it.

    Attributes:
        frames: session_from_camera.
        scale_is_free: whether its unit is unknown.
        options: of the sequence.
    """

    frames: tuple[RigidTransform, ...]
    scale_is_free: bool
    options: SequenceOptions

    @property
    def moves(self) -> bool:
        """Whether there is enough motion to determine the unit."""
        centres = np.array([frame.translation for frame in self.frames])
        extent = float(np.ptp(centres, axis=0).max())
        return extent > self.options.min_motion * float(np.abs(centres).max())

    def first_guess(self, matched_images: Sequence[MatchedImage]) -> Similarity | None:
        """The initial world_from_session with most inliers; None if none has four."""
        cameras = [it.camera_matches(self.frames[it.image]) for it in matched_images]
        total = sum(len(camera.pixels) for camera in cameras)
        candidates = self._of_single_frames(matched_images)
        counts = [inlier_count(cameras, it, self.options.loose_px) for it in candidates]
        if max(counts, default=0) < self.options.enough_share * total:
            candidates += self._of_all_matches(cameras)
            counts = [inlier_count(cameras, it, self.options.loose_px) for it in candidates]
        return candidates[int(np.argmax(counts))] if max(counts, default=0) >= 4 else None

    def _of_single_frames(self, matched_images: Sequence[MatchedImage]) -> list[Similarity]:
        posed = [(it.own_pose, self.frames[it.image]) for it in matched_images if it.own_pose is not None]
        if not self.scale_is_free:
            return [world_from_session_at(pose, frame, 1.0) for pose, frame in posed]
        guesses = []
        for (pose, frame), (other_pose, other_frame) in itertools.combinations(posed, 2):
            travelled = float(np.linalg.norm(other_frame.translation - frame.translation))
            moved_m = float(np.linalg.norm(other_pose.translation - pose.translation))
            if travelled > 0 and moved_m > 0:
                guesses.append(world_from_session_at(pose, frame, moved_m / travelled))
        return guesses

    def _of_all_matches(self, cameras: Sequence[CameraMatches]) -> list[Similarity]:
        options = self.options
        if self.scale_is_free:
            scaled = scaled_ransac(cameras, options.pnp, options.scale_iterations, options.scale_matches)
            return [] if scaled is None else [scaled]
        rigid = rig_ransac(cameras, options.pnp)
        return [] if rigid is None else [Similarity(1.0, rigid.rotation, rigid.translation)]

    def poses(self, matched_images: Sequence[MatchedImage], guess: Similarity) -> list[RigidTransform]:
        """world_from_camera of every frame: its own if consistent, else tracked from the nearest consistent one."""
        own = {it.image: it.own_pose for it in matched_images if it.own_pose is not None}
        consistent = self._consistent_frames(own, guess)
        poses = []
        for i, frame in enumerate(self.frames):
            if not consistent:
                poses.append(guess.transform_pose(frame))
                continue
            nearest = min(consistent, key=lambda j: abs(i - j))
            there = world_from_session_at(own[nearest], self.frames[nearest], guess.scale)
            poses.append(there.transform_pose(frame))
        return poses

    def _consistent_frames(self, own: dict[int, RigidTransform], guess: Similarity) -> list[int]:
        """Frames whose own poses agree with another's by the tracking; or, if none do, with the guess."""
        state = SequenceState.of((), self.frames, guess.scale, False, self.options.drift)
        drift = np.concatenate([np.zeros((1, 6)), np.cumsum(state.sigma, axis=0)])  # largest drift to each frame

        def agree(i: int, j: int) -> bool:
            tracked = world_from_session_at(own[i], self.frames[i], guess.scale).transform_pose(self.frames[j])
            return self._is_near(own[j], tracked, np.abs(drift[j] - drift[i]))

        indices = sorted(own)
        links = np.array([[agree(i, j) for j in indices] for i in indices], bool).reshape(len(own), len(own))
        _, group = connected_components(links, directed=False)
        # After a jump of the tracking there are two such groups, and both are right.
        agreeing = [indices[k] for k in range(len(indices)) if (group == group[k]).sum() > 1]
        if agreeing:
            return agreeing
        as_guessed = [i for i in indices if self._is_near(own[i], guess.transform_pose(self.frames[i]), drift[-1])]
        # If most of the accepted own poses contradict the session, the session is wrong.
        return as_guessed if 2 * len(as_guessed) >= len(indices) else indices

    def _is_near(self, pose: RigidTransform, tracked: RigidTransform, drift: Array) -> bool:
        """Whether a pose is within the drift (6,) of a tracked one."""
        apart_m = float(np.linalg.norm(pose.translation - tracked.translation))
        apart_deg = rotation_angle_deg(pose.rotation.T @ tracked.rotation)
        return apart_m <= self.options.same_position_m + 3 * drift[
            0
        ] and apart_deg <= self.options.same_rotation_deg + 3 * math.degrees(drift[3])
