"""Answers of Localize: `LocalizationResult` and `Rejected`, and their parts."""

from dataclasses import dataclass, field
from datetime import datetime

from .diagnostics import ADOPTION_OFFERS, Debug, Diagnostics, summary_of_missing
from .geodesy import GeoPose
from .geometry import Array, RigidTransform
from .used_intrinsics import IntrinsicsCheck, UsedIntrinsics

DOUBTFUL_TRUST = 0.15
"""Below it, an answer looks worse than 17 of 20 right ones of difficult places: the intrinsics may be wrong."""

_CAPTURED = "captured by the server"


@dataclass(frozen=True)
class Accuracy:
    """Radii of a pose: errors that are not exceeded in 68 and 95 % of cases.

    Attributes:
        position_68_m, position_95_m, rotation_68_deg, rotation_95_deg: the radii.
        calibrated: whether they were measured in this scene on photographs with known poses.
        calibration: "GENERIC", "SELF" (by the scene's references) or "MEASURED".
        sample_size: number of references that were localized against the others ("SELF"), or of photographs measured.
    """

    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float
    calibrated: bool = False
    calibration: str = "GENERIC"
    sample_size: int = 0

    @property
    def calibrated_by(self) -> str:
        """The source of the radii's calibration, as a phrase for a person."""
        if self.calibration == "SELF":
            return f"by {self.sample_size} of the scene's references"
        if self.calibrated:
            return f"on {self.sample_size} photographs" if self.sample_size else "on photographs"
        return ""

    def text(self, kind: str, unit: str) -> str:
        """The radii of a `kind`, "position" or "rotation", as a phrase; `unit` is "m", "units" or "deg"."""
        suffix = "m" if kind == "position" else "deg"
        radii = [getattr(self, f"{kind}_{share}_{suffix}") for share in (68, 95)]
        shown = unit
        if unit == "m" and radii[0] < 1:
            radii, shown = [100 * it for it in radii], "cm"
        note = f"calibrated {self.calibrated_by}" if self.calibrated_by else "uncalibrated"
        return f"within {_plain(radii[0])} {shown} (68 %), {_plain(radii[1])} {shown} (95 %, {note})"


def _plain(number: float) -> str:
    """Two digits, and all before the decimal point: 0.82, 1.4, 140."""
    return f"{number:.0f}" if number >= 99.5 else f"{number:.2g}"


@dataclass(frozen=True, eq=False)
class FramedPose:
    """A pose in the requested axes, "ARKIT" for instance; see `mapless.axes`.

    Attributes:
        axes: name of the axes.
        world_from_camera: both frames in these axes.
        covariance: (6, 6) in these axes, order x y z rx ry rz; None if not estimated.
        world_from_session: transform from the device's session to the world; None if no `session_from_camera` was sent.
    """

    axes: str
    world_from_camera: RigidTransform
    covariance: Array | None
    world_from_session: RigidTransform | None


@dataclass(frozen=True)
class PriorCheck:
    """How an answer compares with a soft prior.

    Attributes:
        kind: "POSITION", "HEADING", "GRAVITY" or "POSE".
        mahalanobis: distance between the prior and the pose from the photograph alone, with the covariances of both.
        degrees_of_freedom: degrees of freedom of the comparison.
        conflict: whether the prior contradicts the photograph.
        used: whether it contributed to the pose.
    """

    kind: str
    mahalanobis: float
    degrees_of_freedom: int
    conflict: bool
    used: bool

    def __str__(self) -> str:
        if self.conflict:
            ignored = "" if self.used else ", not used"
            return f"{self.kind} contradicts the photograph: {self.mahalanobis:.1f} standard deviations{ignored}"
        return f"{self.kind} agrees, " + ("used" if self.used else "less certain than the photograph, not needed")


POINT_SOURCES = {
    "TRIANGULATED": "triangulated",
    "MEASURED_DEPTH": "by measured depth",
    "KEPT_DEPTH": "by kept depth",
    "NETWORK_DEPTH": "by a network's depth",
    "PHOTOGRAPH_DEPTH": "by the photograph's own depth",
}
"""Words for the sources of points; see `Debug.source`."""


@dataclass(frozen=True)
class Hint:
    """Advice after a rejection.

    Attributes:
        stage: the stage that failed; empty if none began.
        advice: for programs: the value of Advice without its prefix, "RETAKE_PHOTOGRAPH".
        message: one sentence for a person.
        best_reference: name of the reference with the most in common with the photograph; empty if there is none.
    """

    stage: str
    advice: str
    message: str
    best_reference: str


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A possible pose of the photograph; it is no answer.

    Attributes:
        world_from_camera: as of `LocalizationResult`.
        inlier_count: number of matches that agree with it.
        references: names of the references that support it.
        covariance, accuracy: as of `LocalizationResult`, of a pose that is rejected for its radius alone; else None.
        arbitrary_unit, in_axes, geo_pose: likewise.
        scene: name of the scene in whose world it is; the two of an ambiguous photograph may be in two scenes.
    """

    world_from_camera: RigidTransform
    inlier_count: int
    references: tuple[str, ...]
    covariance: Array | None = None
    accuracy: Accuracy | None = None
    arbitrary_unit: bool = False
    in_axes: FramedPose | None = None
    geo_pose: GeoPose | None = None
    scene: str = ""


@dataclass(frozen=True, eq=False)
class LocalizationResult:
    """The pose of a photograph, with its accuracy.

    Attributes:
        world_from_camera: the camera's pose; its translation is the camera centre in the scene's world frame, metres.
        covariance: (6, 6), order x y z rx ry rz, metres and radians about fixed world axes; None if not estimated.
        accuracy: radii of the pose; None without covariance.
        trust: share of right answers that look no better than this one, 0 to 1; None for an unverified pose.
        in_axes: the same pose in the requested axes, with `world_from_session`.
        geo_pose: the same pose on the Earth; None unless the scene has a datum.
        prior_checks: how the answer compares with each soft prior.
        intrinsics_checks: comparison of each intrinsic parameter with the photograph; empty for a pose without
            refinement.
        used_intrinsics: the intrinsics with which it was computed; None of servers before 0.4.
        arbitrary_unit: whether lengths are in the scene's own, arbitrary unit, also where a name says metres.
        scale_source: the basis of its lengths: "REFERENCES", or for a single reference "NETWORK" or "DEPTH".
        pose_stage: "REFINED" or "INITIAL"; "COARSE" for an unverified pose, either of a call with `allow_coarse` that
            ran out of time, or the first of `localize_progressively` with it.
        inlier_count, match_count: number of 2D-3D matches that agree with the pose, and of all matches.
        reprojection_error_px: median of the inliers, pixels of the processed image.
        debug: the matches that support it, if requested.
        capture_time, session_from_camera: as they were sent.
        is_final: False only for answers of `localize_progressively` which another one follows.
        scene: name of the scene in whose world it is; of several, the one that was found. Empty from servers before
            0.4.
    """

    world_from_camera: RigidTransform
    covariance: Array | None
    accuracy: Accuracy | None
    pose_stage: str
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    diagnostics: Diagnostics
    capture_time: datetime | None = None
    session_from_camera: RigidTransform | None = None
    trust: float | None = None
    in_axes: FramedPose | None = None
    geo_pose: GeoPose | None = None
    prior_checks: tuple[PriorCheck, ...] = ()
    debug: Debug | None = None
    is_final: bool = True
    arbitrary_unit: bool = False
    scale_source: str = "REFERENCES"
    intrinsics_checks: tuple[IntrinsicsCheck, ...] = ()
    used_intrinsics: UsedIntrinsics | None = None
    scene: str = ""

    @property
    def world_from_session(self) -> RigidTransform | None:
        """Transform from the device's session to the world, requested axes; None without `session_from_camera`.

        The answer holds for the moment of capture. The device's current pose in the world is `world_from_session` times
        its current `session_from_camera`.
        """
        return None if self.in_axes is None else self.in_axes.world_from_session

    def __str__(self) -> str:
        pose, frame = self.world_from_camera, ""
        if self.in_axes is not None and self.in_axes.axes != "OPENCV":
            pose, frame = self.in_axes.world_from_camera, f"   in {self.in_axes.axes} axes"
        text = [f"{_outcome(self, in_scene(self.scene))}{frame}", *pose_lines(pose, self.accuracy, self.arbitrary_unit)]
        if self.geo_pose is not None:
            geo = self.geo_pose
            text.append(f"  on earth  {geo.lat:.7f}, {geo.lon:.7f}, {geo.h:.2f} m")
        text += [f"  prior     {check}" for check in self.prior_checks]
        text += [f"  camera    {it}" for it in _chosen(self.used_intrinsics)]
        text += [f"  camera    {check}" for check in self.intrinsics_checks if check.differs]
        captured = f", {_CAPTURED}" if self.diagnostics.captured else ""
        tracked = ", tracked" if self.diagnostics.is_tracked else ""
        text.append(f"  support   {_support(self)}, {self.diagnostics.total_s:.2f} s{tracked}{captured}")
        if self.debug is not None and (counts := self.debug.inliers_by_source()):
            points = ", ".join(f"{count} {POINT_SOURCES.get(it, it)}" for it, count in counts.items() if count)
            text.append(f"  points    {points}")
        text += [f"  depth     {it}" for it in (self.diagnostics.depth_check,) if it is not None]
        text += [f"  adoption  {ADOPTION_OFFERS.get(it, it)}" for it in (self.diagnostics.adoption,) if it]
        text += [f"  cut       {it}" for it in self.diagnostics.ladder_cuts]
        if self.diagnostics.ladder_cuts or (self.trust is not None and self.trust < DOUBTFUL_TRUST):
            text += [f"  missing   {it}" for it in _missing(self.diagnostics)]
        if self.arbitrary_unit:
            text.append("  warning   the scene's unit of length is arbitrary, not the metre")
        if self.scale_source == "NETWORK":
            text.append("  warning   a single reference: its distance is a network's estimate, as the radius says")
        if self.trust is not None and self.trust < DOUBTFUL_TRUST:
            doubtful = f"fewer than {100 * DOUBTFUL_TRUST:g} % of right answers look as doubtful"
            advice = f"check the intrinsics, take another photograph, or ask for --coverage {1 - DOUBTFUL_TRUST:g}"
            text.append(f"  warning   {doubtful}: {advice}")
        return "\n".join(text)


@dataclass(frozen=True, eq=False)
class Rejected:
    """The server could not localize the photograph.

    Attributes:
        reason: for programs: the value of RejectionReason without its prefix, "LOW_OVERLAP".
        message: one sentence for a person, with the numbers that decided.
        hint: advice.
        hypotheses: contradictory poses, the best supported first, if the reason is "AMBIGUOUS"; or, if
            `include_imprecise_pose` was asked for, the one that is rejected for its radius alone, with its accuracy.
        intrinsics_checks: comparison of the intrinsics with the photograph, if a conflict is the reason.
        used_intrinsics: the intrinsics that it was read with; None if none were given and none found.
        debug: the matches, if requested and found.
        capture_time, session_from_camera: as they were sent.
        scene: name of the scene in whose world the poses are; of several, the one whose references matched best. Empty
            if none of several has a reference, and from servers before 0.4.
        outdated_place: name of the reference whose place needs a new survey, if the photograph was compared with
            references of such a place; else empty, and from servers before 0.4.
        is_final: always True.
    """

    reason: str
    message: str
    diagnostics: Diagnostics
    capture_time: datetime | None = None
    session_from_camera: RigidTransform | None = None
    hint: Hint | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    intrinsics_checks: tuple[IntrinsicsCheck, ...] = ()
    debug: Debug | None = None
    used_intrinsics: UsedIntrinsics | None = None
    scene: str = ""
    outdated_place: str = ""
    is_final: bool = field(default=True, init=False)

    def __str__(self) -> str:
        text = [
            rejection_text(
                self.reason,
                self.message,
                self.hint,
                self.hypotheses,
                None if self.diagnostics.is_among_several else self.scene,
            )
        ]
        if self.diagnostics.is_among_several and self.scene and not in_two_scenes(self.hypotheses):
            text.append(f"  of {self.diagnostics.searched_scene_count} scenes, {_id(self.scene)} matched best")
        text += [f"  read with a {it}" for it in _chosen(self.used_intrinsics)]
        for it in (it for it in self.hypotheses if it.accuracy is not None):
            pose, frame = it.world_from_camera, ""
            if it.in_axes is not None and it.in_axes.axes != "OPENCV":
                pose, frame = it.in_axes.world_from_camera, f", in {it.in_axes.axes} axes"
            text += [f"  the pose that is too imprecise{frame}:", *pose_lines(pose, it.accuracy, it.arbitrary_unit)]
        check = self.diagnostics.depth_check
        text += [f"  the photograph's depth: {check.refusal}"] if check is not None and check.refusal else []
        text += [f"  {it}" for it in (*self.diagnostics.ladder_cuts, *_missing(self.diagnostics))]
        if self.diagnostics.captured:
            text.append(f"  {_CAPTURED}")
        text += [f"  adoption: {ADOPTION_OFFERS.get(it, it)}" for it in (self.diagnostics.adoption,) if it]
        return "\n".join(text)


def _missing(diagnostics: Diagnostics) -> list[str]:
    """One line on what references still lack, or none."""
    return [it for it in (summary_of_missing(diagnostics.missing_evidence),) if it]


def rejection_text(
    reason: str, message: str, hint: Hint | None, hypotheses: tuple[Hypothesis, ...], scene: str | None
) -> str:
    """A rejection as a few lines; without its `scene`, of several, references and poses have the name of theirs."""
    text = [f"not localized{in_scene(scene or '')}: {reason}", f"  {message}"]
    for it in (it for it in hypotheses if it.accuracy is None):
        x, y, z = it.world_from_camera.translation
        where = in_scene(it.scene if scene is None else "")
        text.append(f"  pose{where}: position  {x:.3f}  {y:.3f}  {z:.3f}, {it.inlier_count} inliers")
    if hint is not None and hint.message:
        text.append(f"  {hint.message}")
    if hint is not None and hint.best_reference:
        reference = _id(hint.best_reference)
        if scene is None:
            reference = hint.best_reference.removeprefix("scenes/").replace("/references/", "/", 1)
        text.append(f"  shares most with reference {reference}")
    return "\n".join(text)


def in_two_scenes(hypotheses: tuple[Hypothesis, ...]) -> bool:
    """Whether poses are in the worlds of different scenes."""
    return len({it.scene for it in hypotheses}) > 1


def in_scene(scene: str) -> str:
    """A scene as the end of a phrase; empty without one."""
    return f" in {_id(scene)}" if scene else ""


def pose_lines(pose: RigidTransform, accuracy: Accuracy | None, is_arbitrary: bool) -> list[str]:
    """Position and rotation with their radii, a line each."""
    (x, y, z), q = pose.translation, pose.quaternion()
    unit = "units" if is_arbitrary else "m"
    radii = ["" if accuracy is None else f"   {accuracy.text(*it)}" for it in (("position", unit), ("rotation", "deg"))]
    return [
        f"  position  {x:.3f}  {y:.3f}  {z:.3f} {unit}{radii[0]}",
        f"  rotation  x {q.x:.4f}  y {q.y:.4f}  z {q.z:.4f}  w {q.w:.4f}{radii[1]}",
    ]


def _chosen(used: UsedIntrinsics | None) -> list[UsedIntrinsics]:
    """The intrinsics, if the server has chosen them."""
    return [] if used is None or used.source == "GIVEN" else [used]


def _outcome(answer: LocalizationResult, scene: str) -> str:
    follows = "" if answer.is_final else "; the final answer follows"
    if answer.pose_stage == "COARSE":
        return f"coarse pose{scene}{follows}"
    trust = "" if answer.trust is None else f", trust {answer.trust:.3f}"
    return f"localized{scene}{trust}{follows}"


def _id(name: str) -> str:
    """The id of a scene or reference."""
    return name.rpartition("/")[2]


def _support(answer: LocalizationResult) -> str:
    if answer.pose_stage == "COARSE":
        return "not verified"
    used = sum(use.inlier_count > 0 for use in answer.diagnostics.references)
    return f"{answer.inlier_count} of {answer.match_count} matches, {used} references"
