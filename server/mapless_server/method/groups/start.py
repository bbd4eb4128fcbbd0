"""Initial poses of a sequence: from the photographs localized alone and the tracking between them, cut at its jumps.

Each frame gets its own pose, or one tracked from the nearest frame of its part that has one. If no photograph is
localized alone, the initial world_from_session is found from the matches of all (generalized PnP, the whole sequence as
one camera).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapless.geometry import Array, RigidTransform, Similarity

from ..bundle.priors import Priors
from ..features.limits import INEXACT_INLIER_PX, MIN_INLIERS
from ..judge.evidence import PNP as QUICK_PNP
from ..pose.generalized import CameraMatches, inlier_count, rig_ransac, scaled_ransac
from ..pose.pnp import PnpOptions
from ..rejection import Advice, Hint, Rejection, RejectionReason
from .drift import world_from_session_at
from .images import MatchedImage
from .jumps import Chain, Jump, find_jumps

STAGE = "join"
"""Name of the stage in which photographs are posed together."""

CHECK_TRACKING = Hint(
    STAGE,
    Advice.CHECK_CALIBRATION,
    "The tracked poses contradict the photographs: check that session_from_camera is camera-to-session (not its "
    "inverse), in the axes that the request names, and in metres (or set estimate_session_scale).",
)

PNP = PnpOptions()
"""Options of the pose solvers; `MIN_MATCHES` holds for all frames together."""

MIN_MOTION = 1e-6
"""Least extent of a session of unknown unit, as a share of its distance from its own origin; less is rounding."""


@dataclass(frozen=True, eq=False)
class Start:
    """Initial poses.

    Attributes:
        poses: `world_from_camera` of every frame.
        scale: metres per unit of the session.
        jumps: jumps of the tracking.
        cut: index i of each jump's step, from frame i to frame i + 1.
    """

    poses: tuple[RigidTransform, ...]
    scale: float
    jumps: tuple[Jump, ...] = ()
    cut: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Session:
    """The tracked session, and initial poses from it.

    Attributes:
        frames: `session_from_camera` of each frame.
        scale_is_free: whether its unit is unknown.
        priors: priors on the frames' poses, by index.
        unit: the scene's unit of length, in messages.
    """

    frames: tuple[RigidTransform, ...]
    scale_is_free: bool
    priors: Mapping[int, Priors]
    unit: str = "m"

    @property
    def moves(self) -> bool:
        """Whether there is enough motion to determine the session's unit."""
        centres = np.array([frame.translation for frame in self.frames])
        extent = float(np.ptp(centres, axis=0).max())
        return extent > MIN_MOTION * float(np.abs(centres).max())

    def start(self, matched_images: Sequence[MatchedImage]) -> Start | Rejection:
        """Initial poses of all frames: from their own poses and the tracking, or from the matches of all together."""
        matched = {it.image: it for it in matched_images}
        own = {
            it.image: (it.own_pose, it.own_covariance)
            for it in matched_images
            if it.own_pose is not None and it.own_covariance is not None
        }
        known_scale = None if self.scale_is_free else 1.0
        while chain := find_jumps(own, self.frames, known_scale):
            outvoted = [i for i in own if any(self._is_outvoted(matched[i], jump, chain, own) for jump in chain.jumps)]
            if not outvoted:
                break
            own = {i: own[i] for i in own if i not in outvoted}
        if chain is None:
            guess = self._of_all_matches([it.camera_matches(self.frames[it.image]) for it in matched_images])
            if guess is None:
                total = sum(len(it.matches) for it in matched_images)
                message = f"no poses of the sequence explain four of {total} matches"
                return Rejection(RejectionReason.PNP_FAILED, message)
            return Start(tuple(guess.transform_pose(frame) for frame in self.frames), guess.scale)
        if not chain.is_certain:
            jumps = "; ".join(it.described(self.unit) for it in chain.jumps)
            message = f"the session's steps contradict one another in any unit; in that of one of them, {jumps}"
            return Rejection(RejectionReason.SCALE_UNRELIABLE, message, CHECK_TRACKING)
        return self._cut(matched, {i: own[i][0] for i in chain.frames}, chain)

    def _is_outvoted(
        self, matched: MatchedImage, jump: Jump, chain: Chain, own: Mapping[int, tuple[RigidTransform, Array]]
    ) -> bool:
        """Whether a photograph beside a jump shows what it would without the jump, rather than at its own pose."""
        if matched.image not in (jump.before, jump.after):
            return False
        other = jump.before if matched.image == jump.after else jump.after
        tracked = self._tracked(matched.image, own[other][0], other, chain.scale)
        return self._inliers(matched, tracked) > self._inliers(matched, own[matched.image][0])

    def _tracked(self, image: int, pose: RigidTransform, frame: int, scale: float) -> RigidTransform:
        """`world_from_camera` of an image, tracked from the pose of a frame."""
        return world_from_session_at(pose, self.frames[frame], scale).transform_pose(self.frames[image])

    def _inliers(self, matched: MatchedImage, pose: RigidTransform) -> int:
        camera = matched.camera_matches(RigidTransform.identity())
        return int(camera.inliers(pose, INEXACT_INLIER_PX).sum())

    def _of_all_matches(self, cameras: Sequence[CameraMatches]) -> Similarity | None:
        """Estimates `world_from_session` of the whole sequence as one camera; None if no pose explains four matches."""
        if self.scale_is_free:
            guess = scaled_ransac(cameras, QUICK_PNP)
        else:
            rigid = rig_ransac(cameras, PNP)
            guess = None if rigid is None else Similarity(1.0, rigid.rotation, rigid.translation)
        if guess is None or inlier_count(cameras, guess, INEXACT_INLIER_PX) < MIN_INLIERS:
            return None
        return guess

    def _cut(self, matched: Mapping[int, MatchedImage], own: Mapping[int, RigidTransform], chain: Chain) -> Start:
        """Initial poses, each from the nearest own pose on the same side of all jumps."""

        def tracked(image: int, nearest: int) -> RigidTransform:
            return self._tracked(image, own[nearest], nearest, chain.scale)

        def inliers(image: int, nearest: int) -> int:
            return self._inliers(matched[image], tracked(image, nearest)) if image in matched else 0

        jumps, cut = [], []
        for jump in chain.jumps:
            between = range(jump.before + 1, jump.after)
            earlier, later = ([inliers(i, end) for i in between] for end in (jump.before, jump.after))
            # The frames up to the cut agree with the side before it, those after it with the other.
            step = max(
                range(jump.before, jump.after), key=lambda k: sum(earlier[: k - jump.before] + later[k - jump.before :])
            )
            before = max(
                (i for i in between if i <= step and earlier[i - between[0]] >= MIN_INLIERS), default=jump.before
            )
            after = min((i for i in between if i > step and later[i - between[0]] >= MIN_INLIERS), default=jump.after)
            jumps.append(replace(jump, before=before, after=after))
            cut.append(step)
        part = np.searchsorted(cut, np.arange(len(self.frames)), side="left")
        poses = [
            tracked(i, min((j for j in own if part[j] == part[i]), key=lambda j: abs(i - j)))
            for i in range(len(self.frames))
        ]
        return Start(tuple(poses), chain.scale, tuple(jumps), tuple(cut))
