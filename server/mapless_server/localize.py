"""The method on one screen (types first; body follows)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum

from mapless.geometry import Array, RigidTransform

from .views import PosedView, View


class Variant(str, Enum):
    COARSE = "coarse"
    NO_STRUCTURE = "no_structure"
    FULL = "full"
    BEST = "best"


class ScaleStrategy(str, Enum):
    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"
    TWO_STAGE = "two_stage"


class RejectionReason(str, Enum):
    NO_USABLE_REFERENCES = "no_usable_references"
    DEGENERATE_REFERENCES = "degenerate_references"
    LOW_TEXTURE = "low_texture"
    LOW_OVERLAP = "low_overlap"
    SCALE_UNRELIABLE = "scale_unreliable"
    TOO_FEW_MATCHES = "too_few_matches"
    PNP_FAILED = "pnp_failed"
    GATE = "gate"


class PoseStage(str, Enum):
    INITIAL = "initial"
    REFINED = "refined"


class ScaleStage(str, Enum):
    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"


@dataclass(frozen=True)
class LocalizeOptions:
    variant: Variant = Variant.BEST
    scale_strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE


@dataclass(frozen=True, eq=False)
class Localization:
    world_from_camera: RigidTransform
    covariance: Array | None  # (6, 6) order x y z rx ry rz, fixed world axes, metres and radians
    pose_stage: PoseStage
    inlier_count: int
    match_count: int
    reprojection_error_px: float


@dataclass(frozen=True)
class Rejection:
    reason: RejectionReason
    message: str


@dataclass(frozen=True)
class UsedScale:
    metres_per_unit: float
    stage: ScaleStage
    deviation: float


@dataclass(frozen=True, eq=False)
class Answer:
    outcome: Localization | Rejection
    scale: UsedScale | None
    stage_seconds: dict[str, float] = field(default_factory=dict)
    reference_match_counts: tuple[int, ...] = ()  # per reference, in order
    reference_inlier_counts: tuple[int, ...] = ()  # per reference, in order


def localize(query: View, references: Sequence[PosedView], pipeline: object, options: LocalizeOptions) -> Answer:
    raise NotImplementedError
