"""Data that an answer was computed from: references, matches, attempts, software and times."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .depth import implausible_median
from .geometry import Array


@dataclass(frozen=True)
class ReferenceUse:
    """The contribution of one reference: its matches with the photograph, and how many of them are inliers of the pose.

    `similarity` is the cosine similarity to the photograph, -1 to 1, if the server chose the reference; else 0.
    """

    name: str
    match_count: int
    inlier_count: int
    similarity: float = 0.0


@dataclass(frozen=True)
class SceneUse:
    """One of several scenes, as far as the photograph resembles its references.

    Attributes:
        scene: its name.
        reference_count: its references among those of all scenes that resemble the photograph most.
        similarity: largest similarity of one of them, as of `ReferenceUse`.
        match_count: most matches of the photograph with one of them.
        attempted: whether a pose was looked for in it.
        agreement: number of matches that agree on one turn, scale and shift of the images, divided by the square root
            of the number of all, by which scenes are ordered; 0 where no other scene has such references.
    """

    scene: str
    reference_count: int
    similarity: float
    match_count: int
    attempted: bool
    agreement: float = 0.0


@dataclass(frozen=True)
class ScaleEstimate:
    """The reconstruction's metric scale.

    Attributes:
        metres_per_unit: the scale.
        stage: how it was estimated, "TRIANGULATION" or "TRAJECTORY".
        deviation: relative deviation of the scaled camera trajectory's radius from the true one.
    """

    metres_per_unit: float
    stage: str
    deviation: float


@dataclass(frozen=True)
class Attempt:
    """One attempt at the pose of a photograph.

    Attributes:
        rung: the difference from the other attempts, "wide" for instance.
        features: the local features used.
        outcome: "localized", the reason of its rejection, such as "too_few_matches", or how it ended without a verdict:
            "unfinished", "out_of_memory" or "failed".
        duration_s: computing time, seconds.
        processor_s: processor time, seconds.
        chosen: whether the answer came from it.
    """

    rung: str
    features: str
    outcome: str
    duration_s: float
    processor_s: float
    chosen: bool = False


@dataclass(frozen=True)
class LadderCut:
    """Attempts that were left out, or one that was not finished, for another reason than what the photograph shows.

    Attributes:
        rung: the first attempt that was left out, or that was not finished.
        features: the local features that it would have used.
        reason: the value of LadderCutReason without its prefix: "NO_TIME", or "CALLER_FAILS" where the caller's last
            photographs all failed and others ask.
        unmatched_reference_count: references with which a network did not match the photograph any more, though the
            attempt was made; else 0.
    """

    rung: str
    features: str
    reason: str
    unmatched_reference_count: int = 0

    def __str__(self) -> str:
        reason = _CUT_REASONS.get(self.reason, self.reason)
        if self.unmatched_reference_count:
            return f"{self.rung} with {self.unmatched_reference_count} references fewer: {reason}"
        return f"{self.rung} left out or not finished: {reason}"


@dataclass(frozen=True)
class MissingEvidence:
    """Something that references lacked for a photograph, because the server has not made it in the background yet.

    Attributes:
        kind: "features", "retrieval", "matches" or "calibration".
        name: of the features, vectors or matches.
        reference_count: references of the scene that lacked it.
        made_reference_count: of these, those for which this call made it.
    """

    kind: str
    name: str
    reference_count: int
    made_reference_count: int = 0

    def __str__(self) -> str:
        made = f", {self.made_reference_count} of them made now" if self.made_reference_count else ""
        return f"{self.reference_count} references had no {_KINDS.get(self.kind, self.kind)} yet ({self.name}){made}"


_KINDS = {
    "features": "features for further attempts",
    "retrieval": "vectors to choose references",
    "matches": "matches with one another",
    "calibration": "calibration of radii",
}


def summary_of_missing(missing: Iterable[MissingEvidence]) -> str:
    """Says what references still lack that could help to localize a photograph; empty if they lack nothing of it."""
    most = dict[str, int]()
    for it in missing:
        left = it.reference_count - it.made_reference_count
        if left and it.kind != "calibration":
            most[it.kind] = max(most.get(it.kind, 0), left)
    lacking = [f"{count} references still lack {_KINDS.get(kind, kind)}" for kind, count in most.items()]
    lacking[1:] = [it.replace(" references still lack", "") for it in lacking[1:]]
    return f"{', '.join(lacking)}; ask again later" if lacking else ""


_CUT_REASONS = {
    "NO_TIME": "no time",
    "CALLER_FAILS": "this caller's last photographs all failed, and others ask",
    "FEATURES_MISSING": "references still lack features, made in the background",
    "OUT_OF_MEMORY": "too little memory",
    "FAILED": "an error, which is in the server's log",
}


@dataclass(frozen=True)
class DepthCheck:
    """How the depth that was measured with a photograph compares with its matches at the answered pose.

    Attributes:
        keypoint_count: keypoints of the photograph that have a depth; 0 where no attempt came so far.
        compared_count: inliers of the pose with a depth, on points whose own depth does not come from this photograph.
        agreeing_count: those of them whose depths agree within the errors of sensor and points, the common factor
            removed.
        factor: the most probable factor by which all measured depths are longer than those of the pose; 0 where nothing
            was compared.
        factor_sigma: its standard deviation, as a share.
        conflict: whether the depths contradict the pose, or their own matches, or cannot be metres; they do not correct
            the pose then.
        used: whether the depths contributed to the pose: improved it, or gave points.
        median: median of the whole depth image, in the unit of poses; 0 where no attempt came so far.
        point_count: inliers of the pose on points whose distance these depths give.
    """

    keypoint_count: int
    compared_count: int
    agreeing_count: int
    factor: float
    factor_sigma: float
    conflict: bool
    used: bool
    median: float = 0.0
    point_count: int = 0

    @property
    def refusal(self) -> str:
        """Why a depth that cannot be metres is not used; empty for another one, and of servers before 0.4."""
        text = implausible_median(self.median) if self.median and self.conflict and not self.compared_count else ""
        return text and f"its median is {text}: not used; is unit_m right, 0.001 for millimetres?"

    def __str__(self) -> str:
        if self.refusal:
            return self.refusal
        gives = f"gives {self.point_count} of the points" if self.point_count else ""
        if not self.factor:
            outcome = gives or f"too few to compare ({self.compared_count})"
            doubt = "; they contradict their own matches" if self.conflict else ""
            return f"{self.keypoint_count} keypoints have one, {outcome}{doubt}"
        outcome = "contradicts the photograph, not used" if self.conflict else "used" if self.used else "not needed"
        if gives:
            outcome = f"contradicts other points, {gives}" if self.conflict else gives
        factor = f"{self.factor:.4g} (+- {100 * self.factor_sigma:.2g} %) times the pose's"
        return f"{self.agreeing_count} of {self.compared_count} agree, {factor}: {outcome}"


ADOPTION_OFFERS = {
    "WAITING": "may become a reference, once the server has time to consider it",
    "SCENE_ADOPTS_NOTHING": "not kept: the scene adopts nothing",
    "CONFIDENTIAL": "not kept: the call is confidential",
    "REFERENCES_NAMED": "not kept: the call names references",
    "NOT_LOCALIZED": "not kept: it is not localized",
    "UNCERTAIN": "not kept: it is less certain than the scene's policy asks for",
    "QUEUE_FULL": "not kept: too many photographs wait to be considered",
}
"""Sentences about a photograph whose call allows adoption."""


@dataclass(frozen=True)
class Diagnostics:
    """Data and software that an answer was computed from, and the time it took.

    Attributes:
        request_id: identifies the call in the server's log.
        backend, weights_sha256, features, variant, store_generation, server_version: software, options and data used.
        references: the references used, in the order given or chosen.
        scale: None if its stage was not reached.
        stage_s: seconds by stage, in order.
        queue_s, total_s: time in the queue and total time in the server, seconds.
        processed_width_px, processed_height_px: size of the processed image.
        retrieval: descriptor that chose the references; empty if they were used as given; "pose-prior" if the
            photograph was tracked.
        captured: whether the server keeps the call for a time, including the photograph.
        processor_s: processor time of the server's own threads for this photograph, seconds.
        stationary_keypoint_count: keypoints that were left out because they are fixed to the camera, such as a bonnet.
        attempts: the attempts that were made, in order; none of a server older than 0.4.
        ladder_cuts: attempts that were left out or not finished for lack of time or memory, or because others ask;
            asking again may help.
        missing_evidence: what references lacked for further attempts; asking again later may help.
        depth_check: how the photograph's depth compares with the answer; None without depth, and of a server before
            0.4, which ignores it.
        scenes: of several scenes, those with references that resemble the photograph most, the best first, by
            their agreement.
        searched_scene_count: number of scenes in which references were looked for; 0 of a server before 0.4.
        adoption: what became of `allow_adoption`, a key of `ADOPTION_OFFERS` such as "WAITING"; empty where it was not
            set, and from a server before 0.4.
    """

    request_id: str
    backend: str
    weights_sha256: str
    features: str
    variant: str
    store_generation: int
    references: tuple[ReferenceUse, ...]
    scale: ScaleEstimate | None
    stage_s: Mapping[str, float]
    queue_s: float
    total_s: float
    processed_width_px: int
    processed_height_px: int
    server_version: str
    retrieval: str = ""
    captured: bool = False
    processor_s: float = 0.0
    stationary_keypoint_count: int = 0
    attempts: tuple[Attempt, ...] = ()
    ladder_cuts: tuple[LadderCut, ...] = ()
    depth_check: DepthCheck | None = None
    missing_evidence: tuple[MissingEvidence, ...] = ()
    scenes: tuple[SceneUse, ...] = ()
    searched_scene_count: int = 0
    adoption: str = ""

    @property
    def is_among_several(self) -> bool:
        """Whether the scene was found among several."""
        return self.searched_scene_count > 1

    @property
    def is_tracked(self) -> bool:
        """Whether the references nearest to the pose prior gave the answer, without a search."""
        return self.retrieval == "pose-prior"


@dataclass(frozen=True, eq=False)
class Debug:
    """The 2D-3D matches that support a pose; pixels are those of the original photographs.

    Attributes:
        query_px: (M, 2) keypoints in the photograph.
        x_in_world: (M, 3) the points, metres.
        is_inlier: (M,) whether the match agrees with the pose.
        error_px: (M,) reprojection errors, pixels of the processed image; NaN if undefined.
        reference: (M,) index into `Diagnostics.references` of a reference that shows the point.
        reference_px: (M, 2) the point's pixel in that reference.
        source: (M,) what gives the point its distance, the value of PointSource without its prefix: "TRIANGULATED",
            "MEASURED_DEPTH", "KEPT_DEPTH", "NETWORK_DEPTH" or "PHOTOGRAPH_DEPTH"; (0,) from servers older than 0.4.
    """

    query_px: Array
    x_in_world: Array
    is_inlier: NDArray[np.bool_]
    error_px: Array
    reference: NDArray[np.intp]
    reference_px: Array
    source: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, np.str_))

    @property
    def is_by_depth(self) -> NDArray[np.bool_]:
        """(M,) whether a depth gives the point its distance; False of servers older than 0.4."""
        return self.source != "TRIANGULATED" if len(self.source) else np.zeros(len(self.is_inlier), bool)

    def inliers_by_source(self) -> dict[str, int]:
        """Number of inliers of each source that a match has; empty from servers older than 0.4."""
        sources = sorted(np.unique(self.source).tolist(), key=lambda it: it != "TRIANGULATED")
        return {it: int(self.is_inlier[self.source == it].sum()) for it in sources}
