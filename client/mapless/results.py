"""Scenes, references, and results of retrieval, audit and coverage."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from .depth import DepthImage
from .geodesy import Datum
from .geometry import Camera, RigidTransform
from .provenance import GIVEN_POSE, Provenance
from .scenes import AdoptionPolicy, Calibration, Vector


@dataclass(frozen=True)
class PendingWork:
    """Work that the server has still to do in the background.

    Attributes:
        kind: "features", "matches" or "calibration".
        name: of the features or matches.
        reference_count: references that wait for it.
    """

    kind: str
    name: str
    reference_count: int

    def __str__(self) -> str:
        return f"{self.kind} of {self.reference_count} references ({self.name})"


def summary_of(pending: Sequence[PendingWork]) -> str:
    """Says for each kind of work how many references wait for some of it; empty if nothing is left."""
    most = dict[str, int]()
    for it in pending:
        most[it.kind] = max(most.get(it.kind, 0), it.reference_count)
    return ", ".join(f"{kind} of {count} references" for kind, count in most.items())


@dataclass(frozen=True)
class Scene:
    """A set of references that share one world frame; `generation` is raised by every change.

    Attributes:
        scene_id, generation, reference_count, create_time: set by the server.
        datum: position of the world on the Earth; None if unknown.
        down_in_world: unit vector of gravity; None if unknown or given by the datum alone.
        calibration: measured factors of radii; None if never measured.
        arbitrary_unit: whether lengths are in an arbitrary unit, as of a COLMAP model, instead of metres.
        labels: what groups it with other scenes, value by name.
        adoption: which localized photographs become references; None if none do.
        warnings: contradictions of these properties and the references' poses, which `update_scene` found, or of the
            references' intrinsics or poses with one another, of which `get_scene` knows; else empty.
        contradiction: the sentence of the warnings that says that the scene contradicts itself, because its references
            do not agree with their poses; empty if it does not, or is not known to. Of `get_scene` alone.
        compared_pair_count: pairs of references that show enough in common to be compared with their poses.
        agreeing_pair_count: how many of these agree with them.
        pending_work: what the server has still to make of its references in the background; of `get_scene` alone.
        adopted_reference_count: number of adopted references that are in use; None where it is not known, since only
            `get_scene` asks for it, as for the next.
        retired_reference_count: number of references that are retired, surveyed and adopted ones.
    """

    scene_id: str
    generation: int
    reference_count: int
    create_time: datetime
    datum: Datum | None = None
    down_in_world: Vector | None = None
    calibration: Calibration | None = None
    arbitrary_unit: bool = False
    labels: Mapping[str, str] = field(default_factory=dict)
    adoption: AdoptionPolicy | None = None
    warnings: tuple[str, ...] = ()
    contradiction: str = ""
    compared_pair_count: int = 0
    agreeing_pair_count: int = 0
    pending_work: tuple[PendingWork, ...] = ()
    adopted_reference_count: int | None = None
    retired_reference_count: int | None = None


@dataclass(frozen=True)
class PlaceState:
    """What photographs that were considered for adoption showed of the place of a surveyed reference.

    Attributes:
        surveyed_share: share of what their matches explain that the survey explains alone, 0 to 1; the median of ten.
        photograph_count: photographs of the place, see `PlaceReport`.
        contradiction_count: photographs in a row that should show what the surveyed reference shows, and do not.
        is_outdated: whether they show too little of what was surveyed, so that the place needs a new survey.
    """

    surveyed_share: float
    photograph_count: int
    contradiction_count: int
    is_outdated: bool = False


@dataclass(frozen=True, eq=False)
class Reference:
    """A stored photograph.

    Attributes:
        scene_id, reference_id: where it is.
        camera, world_from_camera: as they were given.
        image_sha256: hash of the file, hexadecimal.
        feature_count: local features found in it; with none it is blank, and nothing can be matched with it.
        create_time: when it was stored, by the server's clock.
        image: the file's bytes, if requested.
        mask: the bytes of its mask's file, if requested and there is one.
        mask_sha256: hash of that file, hexadecimal; empty without a mask.
        depth: the depth that was measured with it, if the image is requested and there is one.
        depth_sha256: hash of that depth with all that describes it, hexadecimal; empty without one.
        warnings: contradictions of the scene's datum, direction of gravity and unit and the poses stored in the same
            message, which `add_reference` and `add_references` found, and that the scene contradicts itself, as far as
            that was known; else empty.
        provenance: how its pose is known.
        retire_time: when the server retired it, so that it is chosen no more; None if it is not retired.
        retirement: why, one sentence for a person; empty if it is not retired.
        place: what photographs showed of its place that were considered for adoption; None where there were none.
        place_reference: of an adopted one, the id of the surveyed reference whose place it is at; empty if that one is
            not known or was deleted. Of others empty.
    """

    scene_id: str
    reference_id: str
    camera: Camera
    world_from_camera: RigidTransform
    image_sha256: str
    feature_count: int
    create_time: datetime
    image: bytes | None = field(default=None, repr=False)
    warnings: tuple[str, ...] = ()
    mask: bytes | None = field(default=None, repr=False)
    mask_sha256: str = ""
    provenance: Provenance = GIVEN_POSE
    depth: DepthImage | None = field(default=None, repr=False)
    depth_sha256: str = ""
    retire_time: datetime | None = None
    retirement: str = ""
    place: PlaceState | None = None
    place_reference: str = ""


@dataclass(frozen=True)
class RestoredReferences:
    """The outcome of restoring retired references.

    Attributes:
        reference_ids: those that are chosen for photographs again, ordered.
        still_retired: why others stay retired, one sentence each by id: adopted ones without what vouches for them, at
            places that need a new survey, or that their places have no room for.
    """

    reference_ids: tuple[str, ...]
    still_retired: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class RetrievedReference:
    """A reference similar to a photograph: its name, cosine similarity (-1 to 1) and pose."""

    name: str
    similarity: float
    world_from_camera: RigidTransform


@dataclass(frozen=True)
class ReferenceAudit:
    """Result of the audit of one reference against its neighbours.

    Attributes:
        name: "scenes/{scene}/references/{reference}".
        verdict: the value of AuditVerdict without its prefix, "CONSISTENT" or "WRONG_POSE".
        message: one sentence for a person, with the numbers that decided.
        neighbour_count, match_count, inlier_count: references compared, matches with them, and matches that agree.
        reprojection_error_px: median of the inliers under the stored pose, pixels of the processed image; 0 if none.
        position_offset_m, rotation_offset_deg: from the stored pose to the one estimated from neighbours; 0 if unknown.
        focal_ratio: focal length estimated from neighbours over the stored one; 0 if unknown.
        other: the reference it is swapped with or a duplicate of; else empty.
        provenance: how its stored pose is known.
    """

    name: str
    verdict: str
    message: str
    neighbour_count: int
    match_count: int
    inlier_count: int
    reprojection_error_px: float
    position_offset_m: float
    rotation_offset_deg: float
    focal_ratio: float
    other: str
    provenance: Provenance = GIVEN_POSE


@dataclass(frozen=True)
class Coverage:
    """Prediction whether a photograph at a pose would be localized.

    Attributes:
        verdict: "LOCALIZABLE", "DOUBTFUL" or "NOT_LOCALIZABLE".
        message: one sentence for a person, with the numbers that decided.
        expected_match_count: expected number of 2D-3D matches.
        image_share: share of the image with matches, 0 to 1.
        position_68_m: expected 68 % radius of the position, metres; None if not predicted.
        references: names of the usable references, those with most matches first.
        arbitrary_unit: whether it is in the scene's own, arbitrary unit instead of metres.
    """

    verdict: str
    message: str
    expected_match_count: int
    image_share: float
    position_68_m: float | None
    references: tuple[str, ...]
    arbitrary_unit: bool = False
