"""`mapless-server evaluate --calibrate`: measures the answers in a stored scene, and the factors of their radii.

The model is that of self-calibration (`mapless_server.scenes.calibration.fit`): photographs with known poses take the
place of the references that are left out there.
"""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapless import Client, LocalizationResult, NotFound, Reference, Rejected, Scene
from mapless.geometry import RigidTransform
from mapless.scenes import Calibration
from mapless_server.images import ImageLimits
from mapless_server.method.bundle.estimate import Accuracy, holding_distance
from mapless_server.scenes.calibration.fit import RIGHT_DEG, RIGHT_SHARE, LeftOut, fit
from mapless_server.services.messages.radii import Conditions, Factors, calibration_of, scaled_accuracy
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.progress import Progress, tracked
from mapless_tools.usage import UsageError

from .metrics import pose_error, trajectory_radius
from .plan import EvaluationOptions, evenly_spread
from .references import PlannedQuery, check_images
from .run import Evaluation, ask, reference_id

MIN_PHOTOGRAPHS = 10
"""With fewer, one photograph changes the share within a radius by more than 10 %."""

MIN_HELD = 0.5
"""Where a smaller share of the errors is within its calibrated radius of 95 %, no factors of the model explain them."""

Measured = tuple[Conditions, LeftOut]
"""An answer compared with the truth, and what computed it."""


@dataclass(frozen=True)
class Measurement:
    """A calibration, and the shares of its right answers whose errors are within the calibrated radii of 95 %."""

    calibration: Calibration
    positions_held: float
    rotations_held: float

    def __str__(self) -> str:
        """A sentence for a person."""
        known = self.calibration
        return (
            f"from {known.query_count} photographs: radii of positions times {known.position_factor_68:.2f}, of angles "
            f"times {known.rotation_factor_68:.2f}; errors of the references' poses "
            f"{100 * known.reference_noise_m:.2f} cm, {known.reference_noise_deg:.3f}°; with these, radii of 95 % hold "
            f"for {100 * self.positions_held:.0f} % of positions and {100 * self.rotations_held:.0f} % of angles"
        )


def photographs(dataset: Dataset, options: EvaluationOptions, limits: ImageLimits) -> list[Frame]:
    """The photographs to localize; UsageError if they cannot calibrate anything."""
    if not dataset.metric:
        raise UsageError(f"{dataset.name}: its unit of length is arbitrary, poses in metres are needed")
    frames = evenly_spread(dataset.frames, options.query_count)
    if len(frames) < MIN_PHOTOGRAPHS:
        raise UsageError(f"{len(frames)} photographs are too few to calibrate a scene, {MIN_PHOTOGRAPHS} are needed")
    check_images(frames, limits)
    return frames


def measure_scene(
    client: Client,
    scene_id: str,
    dataset: Dataset,
    frames: Sequence[Frame],
    options: EvaluationOptions,
    progress: Progress,
) -> tuple[Evaluation, list[Measured]]:
    """Localizes photographs in a stored scene, as if it had no calibration; UsageError if the scene does not suit."""
    scene = _metric_scene(client, scene_id)
    known = list(client.list_references(scene_id, page_size=1000))
    _refuse_references(frames, known, scene_id)
    poses = {it.reference_id: it.world_from_camera for it in known}
    results, measured = [], []
    for frame in tracked("localizing", frames, len(frames), progress):
        query = PlannedQuery(frame, ())
        result, answer = ask(client, scene_id, query, options, poses, ignore_calibration=True, include_debug=True)
        results.append(result)
        if (compared := _compared(frame, answer, poses)) is not None:
            measured.append((Conditions(*_software(answer)), compared))
    radius = trajectory_radius(np.array([it.translation for it in poses.values()])) if poses else 0.0
    return Evaluation(dataset, options, scene.reference_count, radius, tuple(results), scene_id), measured


def fit_calibration(measured: Sequence[Measured]) -> Measurement:
    """Fits the factors to the answers of the method that gave most of them.

    UsageError if too few answers are right, or their errors too large for factors.
    """
    conditions, _ = Counter(it for it, _ in measured).most_common(1)[0] if measured else (None, 0)
    right = [it for computed_by, it in measured if computed_by == conditions and it.is_right]
    if conditions is None or len(right) < MIN_PHOTOGRAPHS:
        raise UsageError(
            f"nothing is stored: {len(right)} photographs are localized within {100 * RIGHT_SHARE:g} % of the "
            f"distance and {RIGHT_DEG:g} degrees by one kind of features, {MIN_PHOTOGRAPHS} are needed; are the "
            "folder's poses in the scene's world?"
        )
    result = _measurement(calibration_of(fit(right, kind="", generation=0), conditions), right)
    if min(result.positions_held, result.rotations_held) < MIN_HELD:
        raise UsageError(
            f"nothing is stored: errors are too large for factors of the radii; by the best, those of 95 % hold for "
            f"{100 * result.positions_held:.0f} % of positions and {100 * result.rotations_held:.0f} % of angles; are "
            "the folder's poses exact?"
        )
    return result


def _measurement(calibration: Calibration, right: Sequence[LeftOut]) -> Measurement:
    radii = [scaled_accuracy(it.claimed, Factors.of(calibration, it.claimed, it.gap)) for it in right]
    return Measurement(
        calibration,
        float(np.mean([it.error_m <= own.position_95_m for it, own in zip(right, radii, strict=True)])),
        float(np.mean([it.error_deg <= own.rotation_95_deg for it, own in zip(right, radii, strict=True)])),
    )


def _metric_scene(client: Client, scene_id: str) -> Scene:
    try:
        scene = client.get_scene(scene_id)
    except NotFound as error:
        raise UsageError(f"there is no scene {scene_id}") from error
    if scene.arbitrary_unit:
        raise UsageError(f"scene {scene_id}: its unit of length is arbitrary, a scene in metres is needed")
    return scene


def _refuse_references(frames: Sequence[Frame], known: Sequence[Reference], scene_id: str) -> None:
    names = {it.image_sha256: it.reference_id for it in known}
    digests = [hashlib.sha256(frame.image_path.read_bytes()).hexdigest() for frame in frames]
    own = [(frame, names[it]) for frame, it in zip(frames, digests, strict=True) if it in names]
    if own:
        frame, name = own[0]
        raise UsageError(
            f"{len(own)} of {len(frames)} photographs are references of scene {scene_id} themselves, the first, "
            f"{frame.image_path.name}, is {name}: their answers would say nothing of others; give other photographs"
        )


def _software(answer: LocalizationResult | Rejected) -> tuple[str, str, str, str]:
    used = answer.diagnostics
    return used.features, used.backend, used.variant, used.server_version


def _compared(
    frame: Frame, answer: LocalizationResult | Rejected, poses: Mapping[str, RigidTransform]
) -> LeftOut | None:
    """Compares an answer with the truth; None without a pose, radii or points."""
    if isinstance(answer, Rejected) or answer.accuracy is None or answer.debug is None:
        return None
    uses = [it for it in answer.diagnostics.references if reference_id(it) in poses]
    inliers = answer.debug.x_in_world[answer.debug.is_inlier]
    if not uses or not len(inliers):
        return None
    depth_m = float(np.median(answer.world_from_camera.inverse().apply(inliers)[:, 2]))
    centres = np.array([poses[reference_id(it)].translation for it in uses])
    distance_m = holding_distance(answer.world_from_camera.translation, centres, [it.inlier_count for it in uses])
    claimed = answer.accuracy
    return LeftOut(
        *pose_error(frame.world_from_camera, answer.world_from_camera),
        Accuracy(claimed.position_68_m, claimed.position_95_m, claimed.rotation_68_deg, claimed.rotation_95_deg),
        answer.trust or 0.0,
        distance_m / depth_m,
        depth_m,
    )
