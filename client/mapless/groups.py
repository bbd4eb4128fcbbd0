"""Photographs that are localized together, of a rig or a sequence: inputs and answers."""

from dataclasses import dataclass, field
from datetime import datetime

from .answers import Accuracy, Hint, Hypothesis, PriorCheck, in_scene, pose_lines, rejection_text
from .axes import Axes, pose_to
from .depth import DepthImage
from .diagnostics import Diagnostics
from .geodesy import GeoPose
from .geometry import Array, Camera, RigidTransform, Similarity
from .priors import Priors
from .requests import ImageSource, IntrinsicsUncertainty
from .used_intrinsics import UsedIntrinsics


@dataclass(frozen=True, eq=False)
class RigImage:
    """The photograph of one camera of a rig.

    Attributes:
        image: the photograph.
        camera: its camera, in pixels of the file as it is stored, before any EXIF rotation; None if it is not known:
            the server then finds it, one for all images with the same make, model and size in their EXIF.
        rig_from_camera: pose of the camera in the rig, metres, OpenCV's axes; the rig's frame is arbitrary.
        references: the references to use, at most 64; empty: the server chooses.
        priors: priors on this camera's pose; soft ones are terms of the joint estimate.
        mask: a PNG of the photograph's size, 0 at the pixels to ignore; None: all are used.
        depth: the depth that a sensor measured with the photograph; None without one.
        intrinsics_uncertainty: as of `Client.localize`.
    """

    image: ImageSource
    camera: Camera | None
    rig_from_camera: RigidTransform
    references: tuple[str, ...] = ()
    priors: Priors = field(default_factory=Priors)
    mask: ImageSource | None = None
    depth: DepthImage | None = None
    intrinsics_uncertainty: IntrinsicsUncertainty | None = None


@dataclass(frozen=True, eq=False)
class SequenceFrame:
    """One photograph of a sequence, with the device's own pose.

    Attributes:
        image: the photograph.
        camera: its camera, in pixels of the file as it is stored, before any EXIF rotation; None if it is not known:
            the server then finds one for all frames without.
        session_from_camera: the pose that the device tracked, in the axes of the call.
        capture_time: time of the photograph, with time zone.
        references: the references to use, at most 64; empty: the server chooses.
        priors: priors on this camera's pose; soft ones are terms of the joint estimate.
        mask: a PNG of the photograph's size, 0 at the pixels to ignore; None: all are used.
        depth: the depth that a sensor measured with the photograph; None without one.
        intrinsics_uncertainty: as of `Client.localize`.
    """

    image: ImageSource
    camera: Camera | None
    session_from_camera: RigidTransform
    capture_time: datetime | None = None
    references: tuple[str, ...] = ()
    priors: Priors = field(default_factory=Priors)
    mask: ImageSource | None = None
    depth: DepthImage | None = None
    intrinsics_uncertainty: IntrinsicsUncertainty | None = None


@dataclass(frozen=True, eq=False)
class ImageReport:
    """Contribution of one photograph to a joint answer.

    Attributes:
        inlier_count: its 2D-3D matches that agree with the joint pose.
        match_count: all its 2D-3D matches.
        rejected_alone: reason of its rejection if localized alone, "LOW_OVERLAP"; None if it would be accepted.
        diagnostics: its inputs and times.
        prior_checks: how the joint pose compares with each of its soft priors.
        hypotheses_alone: as of `Rejected`, if it is rejected alone.
        used_intrinsics: the intrinsics with which the joint pose was computed; None if none were given or found, and
            from older servers.
    """

    inlier_count: int
    match_count: int
    rejected_alone: str | None
    diagnostics: Diagnostics
    prior_checks: tuple[PriorCheck, ...] = ()
    hypotheses_alone: tuple[Hypothesis, ...] = ()
    used_intrinsics: UsedIntrinsics | None = None


@dataclass(frozen=True)
class TrackingJump:
    """A jump of a device's tracking, as its own relocalization makes them.

    Attributes:
        before: index of the last photograph before it.
        after: index of the first one after it. Photographs between the two show too little to say on which side they
            are: their poses may be off by the jump.
        shift_m: distance of the tracked position after it from that of the photographs.
        rotation_deg: angle between the two orientations.
    """

    before: int
    after: int
    shift_m: float
    rotation_deg: float


@dataclass(frozen=True, eq=False)
class RigLocalization:
    """The pose of a rig.

    Attributes:
        world_from_rig: its pose at capture time.
        covariance: (6, 6) of the rig's origin, order x y z rx ry rz, metres and radians about fixed world axes.
        accuracy: radii of the same pose.
        inlier_count, match_count: number of 2D-3D matches of all photographs that agree with the pose, and of all.
        reprojection_error_px: median of the inliers, pixels of the processed images.
        images: contribution of each photograph, in order.
        world_from_session: transform from the device's session to the world; None without `session_from_rig`.
        geo_pose: the same pose on the Earth; None unless the scene has a datum.
        arbitrary_unit: as of `LocalizationResult`.
        capture_time: as it was sent.
        trust: as of `LocalizationResult`, from the evidence of all photographs together.
        scene: as of `LocalizationResult`.
    """

    world_from_rig: RigidTransform
    covariance: Array
    accuracy: Accuracy
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    images: tuple[ImageReport, ...]
    world_from_session: RigidTransform | None = None
    geo_pose: GeoPose | None = None
    capture_time: datetime | None = None
    arbitrary_unit: bool = False
    trust: float | None = None
    scene: str = ""

    def __str__(self) -> str:
        pose = pose_lines(self.world_from_rig, self.accuracy, self.arbitrary_unit)
        return "\n".join([f"rig {_support(self)}", *pose])


@dataclass(frozen=True, eq=False)
class SequenceLocalization:
    """The poses of a sequence.

    Attributes:
        world_from_session: transform from the device's session, after the last photograph, to the world, in the axes
            of the call; its scale is 1 unless it was estimated.
        scale_sigma: standard deviation of that scale; 0 unless it was estimated.
        world_from_camera: pose of each photograph, corrected for drift and jumps, OpenCV's axes.
        covariance: (6, 6) of the last pose, order x y z rx ry rz, metres and radians about fixed world axes.
        accuracy: radii of the same pose.
        inlier_count, match_count: number of 2D-3D matches of all photographs that agree with the poses, and of all.
        reprojection_error_px: median of the inliers, pixels of the processed images.
        images: contribution of each photograph, in order.
        axes: axes of `world_from_session`, "OPENCV".
        arbitrary_unit: as of `LocalizationResult`.
        jumps: where the photographs contradict the tracking, in order. `world_from_session`, covariance, accuracy and
            trust are of the photographs since the last one.
        trust: as of `LocalizationResult`, from the evidence of the photographs since the last jump together.
        scene: as of `LocalizationResult`.
    """

    world_from_session: Similarity
    scale_sigma: float
    world_from_camera: tuple[RigidTransform, ...]
    covariance: Array
    accuracy: Accuracy
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    images: tuple[ImageReport, ...]
    axes: str
    arbitrary_unit: bool = False
    jumps: tuple[TrackingJump, ...] = ()
    trust: float | None = None
    scene: str = ""

    def __str__(self) -> str:
        axes = Axes.__members__.get(self.axes, Axes.OPENCV)
        frame = "" if axes is Axes.OPENCV else f"   in {self.axes} axes"
        last = pose_lines(pose_to(axes, self.world_from_camera[-1]), self.accuracy, self.arbitrary_unit)
        unit = "units" if self.arbitrary_unit else "m"
        jumps = [
            f"  jump      between photographs {it.before} and {it.after}: {it.shift_m:.3g} {unit}, "
            f"{it.rotation_deg:.3g} deg"
            for it in self.jumps
        ]
        return "\n".join([f"sequence {_support(self)}{frame}", *last, *jumps])


@dataclass(frozen=True, eq=False)
class GroupRejected:
    """The server could not localize the photographs together.

    Attributes:
        reason: for programs: the value of RejectionReason without its prefix, "LOW_OVERLAP".
        message: one sentence for a person, with the numbers that decided.
        images: contribution of each photograph, in order.
        hint, hypotheses: as of `Rejected`.
        capture_time: as it was sent.
        scene, outdated_place: as of `Rejected`.
    """

    reason: str
    message: str
    images: tuple[ImageReport, ...]
    hint: Hint | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    capture_time: datetime | None = None
    scene: str = ""
    outdated_place: str = ""

    def __str__(self) -> str:
        return rejection_text(
            self.reason,
            self.message,
            self.hint,
            self.hypotheses,
            None if any(it.diagnostics.is_among_several for it in self.images) else self.scene,
        )


def _support(answer: RigLocalization | SequenceLocalization) -> str:
    trust = "" if answer.trust is None else f", trust {answer.trust:.3f}"
    photographs = f"{len(answer.images)} photographs"
    matches = f"{answer.inlier_count} of {answer.match_count} matches"
    return f"localized{in_scene(answer.scene)}{trust}: {matches}, {photographs}"
