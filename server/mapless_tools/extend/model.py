"""Poses and points by pycolmap, with the references' poses and the cameras that are known held fixed."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from mapless.geometry import Array, RigidTransform
from mapless_tools.progress import Progress
from mapless_tools.reconstruct.matching import SEED
from mapless_tools.reconstruct.native import interruptible

LOSS_PX = 1.0
"""Scale of the Cauchy loss of the last adjustment: about the noise of a keypoint."""
ITERATIONS, DECREASE = 50, 1e-6
"""Most steps of an adjustment, and the relative decrease of its cost at which it has converged."""
SAME_CAMERA_COST = 1.03
"""A camera is taken for the references' if the cost is no larger, as a share of that with a camera of its own. With the
true camera it was 1.004 to 1.016, with focal lengths that differ by 0.2 % 1.04."""


@dataclass(frozen=True)
class Fixed:
    """The part of a model that is known: poses by the names of photographs, and the numbers of cameras."""

    poses: Mapping[str, RigidTransform]
    cameras: frozenset[int]


@dataclass(frozen=True, eq=False)
class Estimate:
    """A photograph's estimated pose; its covariance is (6, 6), order x y z rx ry rz, fixed world axes, in radians.

    Without errors of the references: that of independent keypoints whose noise is that of the residuals.
    """

    world_from_camera: RigidTransform
    covariance: Array


def build_model(database: Path, fixed: Fixed, folder: Path, threads: int, progress: Progress) -> None:
    """Writes a model into a folder: fixed photographs, the others that fit them and one another, and their points."""
    known = folder / "known"
    known.mkdir(parents=True)
    count = _image_count(database)
    options = pycolmap.IncrementalPipelineOptions(
        extract_colors=False,
        random_seed=SEED,
        num_threads=threads,
        min_model_size=1,
        multiple_models=False,
        fix_existing_frames=True,
        constant_cameras=set(fixed.cameras),
    )
    options.mapper.fix_existing_frames = True
    options.triangulation.ignore_two_view_tracks = False  # two references at known poses determine a point
    token = pycolmap.CancellationToken()
    registered = len(fixed.poses)

    def add() -> None:
        nonlocal registered
        registered = min(registered + 1, count)
        progress("poses", registered, count)

    progress("poses", registered, count)
    start = _posed(database, fixed)
    interruptible(
        lambda: pycolmap.triangulate_points(start, database, folder, known, options=options, cancellation_token=token),
        token.cancel,
    )
    interruptible(
        lambda: pycolmap.incremental_mapping(
            database,
            folder,
            folder,
            options,
            input_path=known,
            next_image_callback=add,
            cancellation_token=token,
        ),
        token.cancel,
    )
    progress("poses", count, count)


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """The model of a folder; that of the references alone where no other photograph fits."""
    is_extended = (folder / "images.bin").is_file()
    return pycolmap.Reconstruction(str(folder if is_extended else folder / "known"))


def _image_count(database: Path) -> int:
    with pycolmap.Database.open(database) as content:
        return int(content.num_images())


def _posed(database: Path, fixed: Fixed) -> pycolmap.Reconstruction:
    """The fixed photographs of a database, without points."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as content:
        frames = {it.frame_id: it for it in content.read_all_frames()}
        images = [it for it in content.read_all_images() if it.name in fixed.poses]
        used = {it.camera_id for it in images}
        for camera in content.read_all_cameras():
            if camera.camera_id in used:
                model.add_camera(camera)
        for rig in content.read_all_rigs():
            if rig.ref_sensor_id.id in used:
                model.add_rig(rig)
    for image in images:
        camera_from_world = fixed.poses[image.name].inverse()
        frame = frames[image.frame_id]
        frame.rig_from_world = pycolmap.Rigid3d(
            pycolmap.Rotation3d(camera_from_world.rotation), camera_from_world.translation
        )
        model.add_frame(frame)
        model.add_image(image)
        model.register_frame(frame.frame_id)
    return model


def posed_images(model: pycolmap.Reconstruction) -> Iterator[pycolmap.Image]:
    """The photographs of a model that have a pose, in the order of their numbers."""
    return (it for _, it in sorted(model.images.items()) if it.has_pose)


def pose_of(image: pycolmap.Image) -> RigidTransform:
    """The pose world_from_camera of a photograph of a model."""
    return RigidTransform.from_matrix(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])).inverse()


def adjusted(
    model: pycolmap.Reconstruction, fixed: Fixed, threads: int
) -> tuple[pycolmap.Reconstruction, dict[str, Estimate], float]:
    """A copy of a model after the adjustment of all that is not fixed; the poses that are not, by name; and its cost.

    Pixels are weighted with a Cauchy loss. A pose that the observations do not determine is left out.
    """
    model = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PX
    solver = options.ceres.solver_options
    solver.num_threads, solver.max_num_iterations, solver.function_tolerance = threads, ITERATIONS, DECREASE
    config = pycolmap.BundleAdjustmentConfig()
    for image in posed_images(model):
        config.add_image(image.image_id)
        if image.name in fixed.poses:
            config.set_constant_rig_from_world_pose(image.frame_id)
    for camera_id in fixed.cameras & set(model.cameras):
        config.set_constant_cam_intrinsics(camera_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    summary = interruptible(adjuster.solve)
    assert isinstance(summary, pycolmap.CeresBundleAdjustmentSummary)
    of_poses = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POSES)
    found = interruptible(lambda: pycolmap.estimate_ba_covariance(of_poses, model, adjuster))
    variance = _variance_px2(model)
    estimates = {}
    for image in posed_images(model):
        covariance = None if found is None else found.get_cam_cov_from_world(image.image_id)
        if covariance is not None and np.isfinite(covariance).all():
            estimates[image.name] = Estimate(pose_of(image), variance * _of_pose(image, covariance))
    return model, estimates, float(summary.ceres_summary.final_cost)


def _of_pose(image: pycolmap.Image, covariance: Array) -> Array:
    """Covariance (6, 6) in our order, of pycolmap's of camera_from_world, whose order is rotation, translation."""
    of_inverse = pycolmap.get_covariance_for_inverse(image.cam_from_world(), covariance)
    order = [3, 4, 5, 0, 1, 2]
    return np.asarray(of_inverse)[np.ix_(order, order)]


def _variance_px2(model: pycolmap.Reconstruction) -> float:
    """Variance of a coordinate of a keypoint, pixels squared, of the mean length of the residuals (Rayleigh's)."""
    model.update_point_3d_errors()
    return float(2 / np.pi * model.compute_mean_reprojection_error() ** 2)


def with_free_lenses(model: pycolmap.Reconstruction, fixed: Fixed) -> pycolmap.Reconstruction:
    """A copy of a model whose unknown cameras have focal lengths along both axes and tangential distortion.

    With references fixed, few photographs determine them; a camera that is simpler than the true one turns and moves
    all photographs by several times their errors.
    """
    model = pycolmap.Reconstruction(model)
    for camera_id, camera in model.cameras.items():
        if camera_id not in fixed.cameras and camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL:
            focal, x, y, k1 = camera.params.tolist()
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [focal, focal, x, y, k1, 0.0, 0.0, 0.0]
    return model


def with_camera(model: pycolmap.Reconstruction, camera_id: int, like: pycolmap.Camera) -> pycolmap.Reconstruction:
    """A copy of a model in which a camera has the intrinsics of another one."""
    model = pycolmap.Reconstruction(model)
    camera = model.cameras[camera_id]
    camera.model, camera.params = like.model, like.params.tolist()
    return model


def without(fixed: Fixed, names: Collection[str]) -> Fixed:
    """What is known if the poses of some photographs are not."""
    return Fixed({name: pose for name, pose in fixed.poses.items() if name not in names}, fixed.cameras)


def depths_of(model: pycolmap.Reconstruction, image: pycolmap.Image) -> Array:
    """Depths (N,) of the points that a photograph sees."""
    points = [model.points3D[it.point3D_id].xyz for it in image.points2D if it.has_point3D()]
    return pose_of(image).inverse().apply(np.array(points).reshape(-1, 3))[:, 2]


def references_seen(model: pycolmap.Reconstruction, image: pycolmap.Image, names: Sequence[str]) -> dict[str, int]:
    """How many of a photograph's points each of some others observes, too."""
    counts = dict.fromkeys(names, 0)
    for it in image.points2D:
        if it.has_point3D():
            seen = {model.images[element.image_id].name for element in model.points3D[it.point3D_id].track.elements}
            for name in seen & counts.keys():
                counts[name] += 1
    return counts
