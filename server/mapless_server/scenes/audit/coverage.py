"""Coverage: whether a photograph taken at a pose would be localized, predicted from the references alone.

The references near the pose triangulate their matches. Each of these points that lies in the camera's image is matched
with a probability that decreases with the angle from which it is seen and with the change in scale. The sum is the
expected number of matches; their information about the pose gives the expected accuracy.

Occlusion, light and blur are not known: the prediction is for a good photograph without occlusion.
"""

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform, normalize_jacobian
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.method.optim.optimize import motion_jacobian, world_covariance

from .finder import ReferenceFinder
from .neighbourhood import Neighbourhood, PairMatches, Visibility, Visible, build_neighbourhood, visible_points
from .verdict import Coverage, CoverageVerdict

# Repeatability was measured with SIFT on kitchen, office, fountain and church.
NEIGHBOUR_COUNT = 10
"""References that are used, nearest by position and heading; as many as a query has."""
REPEATABILITY = 0.55
"""Share of the points that are matched when seen from the same direction and distance; with the two below it follows
what was found of 60,000 points at less than 15 degrees and 15,000 beyond."""
TURN_DEG = 24.0
"""Angle between the rays at which this share has decreased to 1/e: it is 0.45 up to 15, 0.22 at 25, 0.1 at 35."""
LOG_SCALE = 0.45
"""Logarithm of the ratio of scales at which this share has decreased to 1/e: a ratio of 1.35 costs half."""
LIMITS = Visibility(max_turn_deg=60.0, max_scale=4.0)
"""Beyond these nothing is matched."""
SIGMA_PX = 1.0
"""Standard deviation of each coordinate of a match, including errors of the references' poses."""
ERROR_INFLATION = 2.0
"""Factor on standard deviations, because errors of neighbouring keypoints and of one reference's points are correlated.
On scenes with known poses true errors were 1.5 to 2.8 times those of independent ones."""
ENOUGH_MATCHES = 80.0
"""Expected matches with which a photograph is localized: 130 of 140 real ones were, the others were blurred or
occluded."""
LEAST_MATCHES = 20.0
"""With fewer a photograph is not localized: 31 of 35 were not."""
ENOUGH_IMAGE_SHARE, MAX_RADIUS_M = 0.15, 0.5
"""A pose from a smaller share of the image, or less accurate, is doubtful."""
COLUMNS, ROWS = 8, 6
"""Size of the grid that the image is divided into."""


def check_coverage(
    camera: Camera, world_from_camera: RigidTransform, finder: ReferenceFinder, pairs: PairMatches
) -> Coverage:
    """Predicts whether a photograph taken by a camera (of the processed image, without distortion) would be localized.

    The pose is metric; `pairs` caches matches between calls.
    """
    world_from_camera = world_from_camera.shifted(-finder.origin)
    names = finder.near_pose(world_from_camera, NEIGHBOUR_COUNT)
    references = finder.views(names)
    if len(references) < 2:
        message = f"{len(references)} references, at least 2 are needed"
        return Coverage(CoverageVerdict.NOT_LOCALIZABLE, message, 0, 0.0, None, ())
    neighbourhood = build_neighbourhood(references, pairs)
    if not len(neighbourhood.structure.x_in_world):
        message = f"not localizable: {len(neighbourhood.references)} references near by share no points"
        return Coverage(CoverageVerdict.NOT_LOCALIZABLE, message, 0, 0.0, None, ())
    visible = visible_points(camera, world_from_camera, neighbourhood, LIMITS)
    found = _probability(visible)
    expected = float(found.sum())
    share = _image_share(camera, visible, found)
    radius_m = _radius_m(camera, world_from_camera, neighbourhood, visible, found)
    serving = np.bincount(visible.reference, weights=found, minlength=len(neighbourhood.references))
    names = [neighbourhood.references[i].name for i in np.argsort(-serving, kind="stable") if serving[i] >= 1]
    verdict, reason = _judge(expected, share, radius_m)
    message = f"{verdict.value.replace('_', ' ')}: {reason}"
    return Coverage(verdict, message, round(expected), share, radius_m, tuple(names))


def _probability(visible: Visible) -> Array:
    """Probability (V,) that each visible point is matched."""
    by_turn = np.exp(-((visible.turn_deg / TURN_DEG) ** 2))
    return np.asarray(REPEATABILITY * by_turn * np.exp(-np.log(visible.scale) / LOG_SCALE))


def _judge(expected: float, share: float, radius_m: float | None) -> tuple[CoverageVerdict, str]:
    matches = f"about {expected:.0f} matches expected in {100 * share:.0f} % of the image"
    if expected < LEAST_MATCHES or radius_m is None:
        return CoverageVerdict.NOT_LOCALIZABLE, f"{matches}, {LEAST_MATCHES:.0f} are needed"
    reason = f"{matches}, position to {100 * radius_m:.1f} cm"
    if expected < ENOUGH_MATCHES:
        return CoverageVerdict.DOUBTFUL, f"{reason}; from {ENOUGH_MATCHES:.0f} matches on one can be sure"
    if share < ENOUGH_IMAGE_SHARE:
        return CoverageVerdict.DOUBTFUL, f"{reason}; they lie in one corner"
    if radius_m > MAX_RADIUS_M:
        return CoverageVerdict.DOUBTFUL, f"{reason}, which is more than {MAX_RADIUS_M:g} m"
    return CoverageVerdict.LOCALIZABLE, reason


def _image_share(camera: Camera, visible: Visible, found: Array) -> float:
    cell = np.floor((visible.pixel + 0.5) / (camera.width_px, camera.height_px) * (COLUMNS, ROWS))
    index = (cell[:, 1] * COLUMNS + cell[:, 0]).astype(np.intp)
    by_cell = np.bincount(index, weights=found, minlength=COLUMNS * ROWS)
    return float((by_cell >= 1).mean())


def _radius_m(
    camera: Camera, world_from_camera: RigidTransform, neighbourhood: Neighbourhood, visible: Visible, found: Array
) -> float | None:
    """Radius that the position error does not exceed in 68 % of cases, metres; points are weighted by probability."""
    if found.sum() < LEAST_MATCHES:
        return None
    camera_from_world = world_from_camera.inverse()
    x_in_camera = camera_from_world.apply(neighbourhood.structure.x_in_world[visible.point])
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    by_point = normalize_jacobian(x_in_camera) * focal[:, None]
    jacobian = by_point @ motion_jacobian(x_in_camera)
    in_image = by_point @ camera_from_world.rotation
    spread = np.einsum("mia,mab,mib->m", in_image, neighbourhood.point_covariance[visible.point], in_image) / 2
    weight = found / (SIGMA_PX**2 + spread)
    hessian = np.einsum("m,mia,mib->ab", weight, jacobian, jacobian)
    covariance = ERROR_INFLATION**2 * world_covariance(hessian, world_from_camera)
    return accuracy_from_covariance(covariance).position_68_m
