"""Inputs and results of the engine: a photograph, what is asked of it, and what is answered."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from mapless_server import __version__
from mapless_server.images import ImageLimits, decode_depth, decode_mask
from mapless_server.method.bundle.priors import NO_PRIORS, Priors
from mapless_server.method.options import ChosenCamera, Variant
from mapless_server.store import SceneAttributes, calibration_kind

if TYPE_CHECKING:  # services need not load what computes
    from numpy.typing import NDArray

    from mapless.depth import DepthImage
    from mapless.geometry import Camera
    from mapless_server.images.exif import Exif
    from mapless_server.method.features.extractors import FeatureExtractor
    from mapless_server.method.features.views import Ignored, PosedView, View
    from mapless_server.method.judge.answer import Answer
    from mapless_server.method.options import LocalizeOptions
    from mapless_server.method.pipeline import Pipeline
    from mapless_server.scenes import Choice, Narrowing
    from mapless_server.scenes.retrieval.index import Vector
    from mapless_server.scheduling import Flow
    from mapless_server.security import SceneKey
    from mapless_server.store import SceneState


@dataclass(frozen=True, eq=False)
class Photo:
    """An encoded image and its camera, perhaps with a mask of ignored pixels, a PNG; empty for none; and with depth.

    `field` is the image's path in the request, for error messages. `exif`, of a photograph without intrinsics, is what
    its camera is chosen by; of `camera` then only the size is known. Where EXIF does not turn it, features are found
    in the raster turned clockwise by `upright_deg`.
    """

    image: bytes
    camera: Camera
    field: str
    mask: bytes = b""
    exif: Exif | None = None
    upright_deg: float = 0.0
    depth: DepthImage | None = None

    @property
    def size_bytes(self) -> int:
        """Size of the encoded image, mask and depth."""
        return len(self.image) + len(self.mask) + (0 if self.depth is None else self.depth.size_bytes)

    def read_ignored(self, limits: ImageLimits) -> Ignored | None:
        """Decodes the mask; None if there is none or it ignores nothing. InvalidArgument if it is bad."""
        if not self.mask:
            return None
        size = self.camera.width_px, self.camera.height_px
        return decode_mask(self.mask, size, limits, self.mask_field)

    def read_depth(self, limits: ImageLimits) -> NDArray[np.float32]:
        """Decodes the depth (H, W), in the unit of poses, NaN where there is none; InvalidArgument if it is bad."""
        assert self.depth is not None
        size = self.camera.width_px, self.camera.height_px
        return decode_depth(self.depth, size, limits, self.field.removesuffix("image") + "depth")

    @property
    def mask_field(self) -> str:
        """Path of the mask in the request."""
        return self.field.removesuffix("image") + "mask"


@dataclass(frozen=True, eq=False)
class Description:
    """The data that the store keeps of a photograph besides the photograph itself.

    Views, without pixels, are by the extractor's name, the first tier's first; descriptors by their own. The mask
    ignores a share of the pixels, 0 to 1; the depth has a median in the unit of poses, None without depth.
    """

    views: Mapping[str, View]
    descriptors: Mapping[str, Vector]
    ignored_share: float = 0.0
    median_depth: float | None = None


PREPARE, COARSE, REFINE = "prepare", "coarse", "refine"
"""The stages of a query."""

POSE_PRIOR = "pose-prior"
"""`Choice.descriptor` of references that were chosen by a pose prior, not by similarity."""

TRACK = "track"
"""The stage of choosing references by the prior and comparing others; or the whole attempt, if it did not suffice."""

MIRROR = "mirror"
"""The stage of comparing a photograph that was not localized, and its mirror image, with references."""

TRYING = "Trying it"
"""Begins the last sentence of a hint, which says what was not finished."""

MAX_TRACKED_SIGMA_DEG = 20.0
"""Priors of a less certain rotation do not say what the photograph shows."""

DEFAULT_REFERENCE_COUNT = 10
"""References that are chosen where the request does not say how many."""


@dataclass(frozen=True, eq=False)
class Tier:
    """Features, with the extractor and the pipeline that use them.

    The pipeline's matcher caches matches of these features, so no other tier may have the same one; tiers may share a
    reconstructor. References of a tier that `uses_depths` are loaded with the depths stored with them. Features that
    match at `any_roll` of the camera, whose extractor `Mirrors`, may follow upright ones. The features of a photograph
    are found in a raster of `max_pixels` at most, those of references in theirs; None for all.
    """

    extractor: FeatureExtractor
    pipeline: Pipeline
    uses_depths: bool = False
    any_roll: bool = False
    max_pixels: int | None = None

    @property
    def features(self) -> str:
        """Name of the local features with their options, "sift-2048-1024px-0.02"."""
        return self.extractor.name

    @property
    def backend(self) -> str:
        """Name of the coarse stage's backend."""
        return self.pipeline.reconstructor.name

    @property
    def kind(self) -> str:
        """Kind of its answers, see `calibration_kind`."""
        backend = f"{self.backend}+depth" if self.uses_depths else self.backend
        features = self.features if self.max_pixels is None else f"{self.features}-{self.max_pixels}"
        return calibration_kind(features, backend, __version__)

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of the backend's weights; empty without any."""
        return self.pipeline.reconstructor.weights_sha256


@dataclass(frozen=True)
class Caller:
    """The caller of the engine: the tenant and its caller, among which the queue shares computing time.

    After `deadline_s`, by `time.monotonic`, the answer is useless.
    """

    flow: Flow
    deadline_s: float


@dataclass(frozen=True, eq=False)
class SceneQuestion:
    """A scene in which a photograph may have been taken, and what the request's priors say in its world.

    Attributes:
        scene_key: the scene.
        narrowing, priors, attributes: as of `Query`.
        generation: a generation that the scene has reached; None if none is known. Whether references in memory are as
            recent is then known without asking the store.
    """

    scene_key: SceneKey
    narrowing: Narrowing
    priors: Priors = NO_PRIORS
    attributes: SceneAttributes | None = None
    generation: int | None = None


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph to localize.

    Attributes:
        scene_key: the scene; of several, the one of the present attempt.
        reference_ids: references to compare it with; if empty, `reference_count` references of the scene are chosen.
        photo: the photograph.
        narrowing: limits of the camera's pose, for choosing references and for checking the answer.
        reference_count: how many references are chosen.
        options: options of the method.
        allow_coarse: whether the coarse pose is the answer if there is no time to refine it.
        rerank: whether `reference_count` of the named references are chosen.
        priors: priors on the pose, each with its uncertainty, in the scene's world.
        is_part: whether it belongs to a rig or a sequence, which needs its matches even if it cannot be localized
            alone.
        is_generic: whether what was measured in the scene is not used for radii and trust.
        attributes: the scene's attributes by which the priors were converted to its world; None if by none.
        scenes: several scenes among which the photograph's is found, in the order of the request; empty for one.
        prior_scene: the one of them in whose world a pose prior was given; None if none was.
    """

    scene_key: SceneKey
    reference_ids: tuple[str, ...]
    photo: Photo
    narrowing: Narrowing
    reference_count: int
    options: LocalizeOptions
    allow_coarse: bool = False
    rerank: bool = False
    priors: Priors = NO_PRIORS
    is_part: bool = False
    is_generic: bool = False
    attributes: SceneAttributes | None = None
    scenes: Sequence[SceneQuestion] = ()
    prior_scene: SceneKey | None = None

    def in_scene(self, question: SceneQuestion) -> Query:
        """The query in one of its scenes."""
        it = question
        return replace(self, scene_key=it.scene_key, narrowing=it.narrowing, priors=it.priors, attributes=it.attributes)

    def in_prior_scene(self) -> tuple[Query, bool]:
        """The query in the scene of its prior, or in any one of its scenes; and whether it can be tracked there."""
        asked = self.scenes if self.prior_scene is not None else ()
        named = next((it for it in asked if it.scene_key == self.prior_scene), None)
        query = self.in_scene(named or self.scenes[0])
        return query, named is not None and query.can_be_tracked

    @property
    def chooses(self) -> bool:
        """Whether the server chooses the references, by their similarity to the photograph."""
        return self.rerank or not self.reference_ids

    @property
    def can_be_tracked(self) -> bool:
        """Whether its prior and options allow tracking, see `tracking`."""
        prior, is_chosen = self.priors.pose, self.photo.exif is not None
        if prior is None or self.reference_ids or self.is_part or self.options.variant is not Variant.BEST or is_chosen:
            return False
        sigma = math.sqrt(float(np.linalg.eigvalsh(prior.covariance[3:, 3:])[-1]))
        return sigma <= math.radians(MAX_TRACKED_SIGMA_DEG)


@dataclass(frozen=True)
class Tried:
    """One attempt at a pose.

    Attributes:
        rung: the attempt's place among the attempts, such as "wide".
        features: the local features' name with their options.
        outcome: "localized", the value of the rejection's reason, or how it ended without a verdict, such as "failed".
        seconds: its computing time.
        processor_s: its processor time.
        agreement: the largest that matches with references have shown until then, see `choosing` and `features.rolls`.
        is_chosen: whether the answer came from it.
    """

    rung: str
    features: str
    outcome: str
    seconds: float
    processor_s: float
    agreement: float = 0.0
    is_chosen: bool = False


class CutReason(str, Enum):
    """Reasons, other than what the photograph shows, why an attempt is left out or not finished."""

    NO_TIME = "no_time"
    CALLER_FAILS = "caller_fails"
    """The caller's last photographs all failed, and others ask: it gets the cheap rungs."""
    FEATURES_MISSING = "features_missing"
    OUT_OF_MEMORY = "out_of_memory"
    FAILED = "failed"


@dataclass(frozen=True)
class LadderCut:
    """Where the ladder was cut for another reason than what the photograph shows.

    Attributes:
        rung: name of the rung of the attempt that was left out, or not finished.
        features: the local features' name with their options.
        reason: why.
        unmatched: if the attempt was made with fewer matches, number of references that the network did not match.
    """

    rung: str
    features: str
    reason: CutReason
    unmatched: int = 0


@dataclass(frozen=True)
class MissingEvidence:
    """Evidence that references lacked for the attempts at a photograph, since the background has not made it yet.

    Attributes:
        kind: "features", "retrieval" for vectors by which references are chosen, "matches" or "calibration".
        name: the features, vectors, matches or answers.
        reference_count: number of references that lacked it.
        made_count: of these, those for which the call made it.
    """

    kind: str
    name: str
    reference_count: int
    made_count: int = 0


@dataclass(frozen=True)
class SceneTried:
    """A scene of several, as far as its references are among those of all that resemble a photograph most.

    Attributes:
        scene_key: the scene.
        reference_count: number of these references.
        similarity: largest similarity of one of them, see `RankedReference`.
        match_count: most matches of the photograph with one of them, estimated where a sample of its keypoints shows
            enough; 0 where no other scene has such references.
        attempted: whether a pose was looked for in the scene.
        agreement: as of `RankedScene`, by which the scenes are ordered.
    """

    scene_key: SceneKey
    reference_count: int
    similarity: float
    match_count: int = 0
    attempted: bool = False
    agreement: float = 0.0


@dataclass(frozen=True, eq=False)
class Result:
    """The answer to a query, and the data that it was computed from.

    Attributes:
        answer: the answer of the method.
        tier: the tier that computed it.
        references: the references that were used, in order.
        scene: the scene as it was when the references were read.
        processed: the camera of the reduced image that features were found in.
        choice: how the references were chosen; None if the caller named them.
        other_choices: how other attempts chose theirs by other descriptors, in order.
        attributes: attributes of the scene, as far as they count for the query.
        stage_seconds: time of every stage that was computed, in order, of all attempts. The name of a stage of other
            features, references or rasters than the first ones begins with the extractor's name and a slash.
        attempts: the attempts that were made, in order.
        cuts: attempts that were left out, or not finished, for another reason than what the photograph shows.
        missing: what references lacked for further attempts.
        camera: the camera that was chosen for a photograph without intrinsics; None if it came with some, or none was
            found.
        scene_key: the scene that the answer's references are of; None if none of several scenes has a reference.
        scenes: of several scenes, those that resemble the photograph most, the one tried first coming first.
        searched_scene_count: number of scenes in which references were looked for.
    """

    answer: Answer
    tier: Tier
    references: tuple[PosedView, ...]
    scene: SceneState
    processed: Camera
    choice: Choice | None = None
    other_choices: tuple[Choice, ...] = ()
    attributes: SceneAttributes = field(default_factory=SceneAttributes)
    stage_seconds: dict[str, float] = field(default_factory=dict)
    attempts: tuple[Tried, ...] = ()
    cuts: tuple[LadderCut, ...] = ()
    missing: tuple[MissingEvidence, ...] = ()
    camera: ChosenCamera | None = None
    scene_key: SceneKey | None = None
    scenes: tuple[SceneTried, ...] = ()
    searched_scene_count: int = 1

    @property
    def generation(self) -> int:
        """Generation of the scene when the references were read."""
        return self.scene.generation

    @property
    def is_tracked(self) -> bool:
        """Whether its references were chosen by a pose prior, see `tracking`."""
        return self.choice is not None and self.choice.descriptor == POSE_PRIOR
