"""The last adjustment of a model of pycolmap's: cameras with principal point and two radial coefficients, robustly.

Mappers keep the principal point in the centre, and have one coefficient, so that they find a beginning. A principal
point that is off by a per cent turns all photographs, and bends their path. So these are free here, with a prior: the
estimate without it and its covariance are combined with it, and all else is adjusted once more.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pycolmap

from mapless.geometry import Array

from .native import interruptible

PRINCIPAL_SHARE = 0.01
"""Standard deviation of a principal point from the centre, over the longer side, as lenses are built."""
COEFFICIENTS = 0.3, 0.1
"""Standard deviations of the radial coefficients of lenses."""
SIGMA_FACTOR = 3.0
"""Principal points are so many standard deviations of independent noise off, measured on six scenes (2 in the median,
5 by root mean square): errors of photographs of one camera are alike."""
LOSS_PX = 1.0
"""Residuals above the noise of keypoints count less, by a Cauchy loss."""
MAX_ERROR_PX = 4.0
"""Mean error of a model that is used: pycolmap's mappers keep no observation with a larger one."""
_TOLERANCE = 1e-6
"""Least relative decrease of the cost of an iteration."""


def refine(model: pycolmap.Reconstruction, known: Collection[int], threads: int) -> bool:
    """Adjusts poses, points and cameras of a model, and returns whether it did; cameras with `known` ids stay.

    It does not if observations do not determine the model, or points end behind cameras: it is not to be used then.
    """
    cameras = [it for key, it in model.cameras.items() if key not in known]
    for camera in cameras:
        if camera.model == pycolmap.CameraModelId.SIMPLE_RADIAL:
            parameters = [*camera.params, 0.0]
            camera.model, camera.params = pycolmap.CameraModelId.RADIAL, parameters
    adjuster = _adjust(model, known, threads, focal_alone=False)
    model.update_point_3d_errors()
    options = pycolmap.BACovarianceOptions(params=pycolmap.BACovarianceOptionsParams.ALL)
    found = interruptible(lambda: pycolmap.estimate_ba_covariance(options, model, adjuster))
    if found is None:
        return False
    for camera in cameras:
        covariance = found.get_other_params_cov(camera.params)
        if covariance is None:
            return False
        sigma_px = SIGMA_FACTOR * model.compute_mean_reprojection_error()
        _apply_prior(camera, sigma_px**2 * covariance)
    _adjust(model, known, threads, focal_alone=True)
    model.update_point_3d_errors()
    return model.compute_mean_reprojection_error() <= MAX_ERROR_PX


def _adjust(
    model: pycolmap.Reconstruction, known: Collection[int], threads: int, focal_alone: bool
) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions(
        refine_principal_point=not focal_alone, refine_extra_params=not focal_alone, print_summary=False
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_PX
    options.ceres.solver_options.function_tolerance = _TOLERANCE
    options.ceres.solver_options.num_threads = threads
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    for camera_id in known:
        if camera_id in model.cameras:
            config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    interruptible(adjuster.solve)
    return adjuster


def _apply_prior(camera: pycolmap.Camera, covariance: Array) -> None:
    """Combines parameters, their estimate's covariance (N, N) beside it, with the prior."""
    side = PRINCIPAL_SHARE * max(camera.width, camera.height)
    rows = [*camera.principal_point_idxs(), *camera.extra_params_idxs()]
    expected = np.array([camera.width / 2, camera.height / 2, 0.0, 0.0])
    prior = np.diag([side, side, *COEFFICIENTS]) ** 2
    gain = covariance[:, rows] @ np.linalg.inv(covariance[np.ix_(rows, rows)] + prior)
    camera.params = (camera.params + gain @ (expected - camera.params[rows])).tolist()
