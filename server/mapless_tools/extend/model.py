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
ITERATIONS, DECREASE = 50, 1e-5
"""Most steps of an adjustment, and the relative decrease of its cost at which it has converged."""
LENS_OBSERVATIONS = 300
"""Fewest observations that determine focal lengths along both axes and tangential distortion."""


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
) -> tuple[pycolmap.Reconstruction, dict[str, Estimate]]:
    """A copy of a model after the adjustment of all that is not fixed, and the poses that are not, by name.

    Pixels are weighted with a Cauchy loss. A pose that the observations do not determine is left out.
    """
    model = pycolmap.Reconstruction(model)
    _keep_seen(model, fixed)
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
    interruptible(adjuster.solve)
    of_poses = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.POSES)
    found = interruptible(lambda: pycolmap.estimate_ba_covariance(of_poses, model, adjuster))
    variance = _variance_px2(model)
    estimates = {}
    for image in posed_images(model):
        covariance = None if found is None else found.get_cam_cov_from_world(image.image_id)
        if covariance is not None and np.isfinite(covariance).all():
            estimates[image.name] = Estimate(pose_of(image), variance * _of_pose(image, covariance))
    return model, estimates


def _keep_seen(model: pycolmap.Reconstruction, fixed: Fixed) -> None:
    """Deletes the points that no photograph sees whose pose is not fixed."""
    free = {it.image_id for it in posed_images(model) if it.name not in fixed.poses}
    for point_id, point in list(model.points3D.items()):
        if not any(it.image_id in free for it in point.track.elements):
            model.delete_point3D(point_id)


def _of_pose(image: pycolmap.Image, covariance: Array) -> Array:
    """Covariance (6, 6) in our order, of pycolmap's of camera_from_world, whose order is rotation, translation."""
    of_inverse = pycolmap.get_covariance_for_inverse(image.cam_from_world(), covariance)
    order = [3, 4, 5, 0, 1, 2]
    return np.asarray(of_inverse)[np.ix_(order, order)]


def _variance_px2(model: pycolmap.Reconstruction) -> float:
    """Variance of a coordinate of a keypoint, pixels squared, of the mean length of the residuals (Rayleigh's)."""
    model.update_point_3d_errors()
    return float(2 / np.pi * model.compute_mean_reprojection_error() ** 2)


def with_free_lenses(model: pycolmap.Reconstruction, camera_ids: Collection[int]) -> pycolmap.Reconstruction:
    """A copy of a model in which cameras have what is refined of an unknown one.

    That are focal lengths along both axes and tangential distortion, where there are observations enough: a camera that
    is simpler than the true one turns and moves its photographs by several times their errors.
    """
    model = pycolmap.Reconstruction(model)
    counts = dict.fromkeys(camera_ids, 0)
    for image in posed_images(model):
        if image.camera_id in counts:
            counts[image.camera_id] += image.num_points3D
    for camera_id, count in counts.items():
        camera, model_ids = model.cameras[camera_id], pycolmap.CameraModelId
        if camera.model not in (model_ids.SIMPLE_RADIAL, model_ids.PINHOLE):
            continue
        x, y = camera.principal_point_x, camera.principal_point_y
        radial = float(camera.params[3]) if camera.model == model_ids.SIMPLE_RADIAL else 0.0
        if count >= LENS_OBSERVATIONS:
            focals = [camera.focal_length_x, camera.focal_length_y] if camera.model == model_ids.PINHOLE else []
            focals = focals or [camera.focal_length] * 2
            camera.model, camera.params = model_ids.OPENCV, [*focals, x, y, radial, 0.0, 0.0, 0.0]
        else:
            camera.model, camera.params = model_ids.SIMPLE_RADIAL, [camera.mean_focal_length(), x, y, radial]
    return model


def without(fixed: Fixed, names: Collection[str], cameras: Collection[int] = ()) -> Fixed:
    """The rest of what is known, without the poses of some photographs and some cameras."""
    poses = {name: pose for name, pose in fixed.poses.items() if name not in names}
    return Fixed(poses, fixed.cameras - set(cameras))


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
