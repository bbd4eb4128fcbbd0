"""Coverage: whether a photograph taken at a pose would be localized, predicted from the references alone.

The references near the pose triangulate their matches. Each of these points that lies in the camera's image is matched
with a probability that decreases with the angle from which it is seen and with the change in scale. The sum is the
expected number of matches; their information about the pose gives the expected accuracy.

Occlusion, light and blur are not known: the prediction is for a good photograph without occlusion.
"""

from dataclasses import dataclass, field

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform, normalize_jacobian
from mapless_server.method.options import check_bounds
from mapless_server.method.perturbation import motion_jacobian, world_covariance
from mapless_server.method.structure import StructureOptions
from mapless_server.method.uncertainty.radii import accuracy_from_covariance

from .finder import ReferenceFinder
from .neighbourhood import Neighbourhood, PairMatches, VisibilityOptions, Visible, build_neighbourhood, visible_points
from .verdict import Coverage, CoverageVerdict


@dataclass(frozen=True)
class CoverageOptions:
    """Options of the prediction; repeatability was measured with SIFT on kitchen, office, fountain and church.

    Attributes:
        neighbour_count: references that are used, nearest by position and heading; as many as a query has.
        epipolar_px: as for matching references.
        repeatability: share of the points that are matched when seen from the same direction and distance; with the two
            below it follows what was found of 60,000 points at less than 15 degrees and 15,000 beyond.
        turn_deg: angle between the rays at which this share has decreased to 1/e: it is 0.45 up to 15, 0.22 at 25, 0.1
            at 35.
        log_scale: logarithm of the ratio of scales at which this share has decreased to 1/e: a ratio of 1.35 costs
            half.
        sigma_px: standard deviation of each coordinate of a match, including errors of the references' poses.
        error_inflation: factor on standard deviations, because errors of neighbouring keypoints and of one reference's
            points are correlated. On scenes with known poses true errors were 1.5 to 2.8 times those of independent
            ones.
        enough_matches: number of expected matches with which a photograph is localized: 130 of 140 real ones were, the
            others were blurred or occluded.
        least_matches: with fewer a photograph is not localized: 31 of 35 were not.
        enough_image_share, max_radius_m: a pose from a smaller share of the image, or less accurate, is doubtful.
        columns, rows: of the grid that the image is divided into.
        visibility: bounds beyond which nothing is matched.
    """

    neighbour_count: int = 10
    epipolar_px: float = 2.0
    repeatability: float = 0.55
    turn_deg: float = 24.0
    log_scale: float = 0.45
    sigma_px: float = 1.0
    error_inflation: float = 2.0
    enough_matches: float = 80.0
    least_matches: float = 20.0
    enough_image_share: float = 0.15
    max_radius_m: float = 0.5
    columns: int = 8
    rows: int = 6
    visibility: VisibilityOptions = field(default_factory=lambda: VisibilityOptions(max_turn_deg=60.0, max_scale=4.0))

    def __post_init__(self) -> None:
        check_bounds(self, "turn_deg log_scale sigma_px error_inflation max_radius_m columns rows epipolar_px", above=0)
        check_bounds(self, "neighbour_count", at_least=2)
        check_bounds(self, "repeatability enough_image_share", above=0, at_most=1)
        check_bounds(self, "least_matches", above=0, at_most=self.enough_matches)


def check_coverage(
    camera: Camera,
    world_from_camera: RigidTransform,
    finder: ReferenceFinder,
    pairs: PairMatches,
    options: CoverageOptions | None = None,
) -> Coverage:
    """Predicts whether a photograph taken by a camera (of the processed image, without distortion) would be localized.

    The pose is metric; `pairs` caches matches between calls.
    """
    options = options or CoverageOptions()
    world_from_camera = world_from_camera.shifted(-finder.origin)
    names = finder.near_pose(world_from_camera, options.neighbour_count)
    references = finder.views(names)
    if len(references) < 2:
        message = f"{len(references)} references, at least 2 are needed"
        return Coverage(CoverageVerdict.NOT_LOCALIZABLE, message, 0, 0.0, None, ())
    neighbourhood = build_neighbourhood(references, pairs, options.epipolar_px, StructureOptions())
    if not len(neighbourhood.structure.x_in_world):
        message = f"not localizable: {len(neighbourhood.references)} references near by share no points"
        return Coverage(CoverageVerdict.NOT_LOCALIZABLE, message, 0, 0.0, None, ())
    visible = visible_points(camera, world_from_camera, neighbourhood, options.visibility)
    found = _probability(visible, options)
    expected = float(found.sum())
    share = _image_share(camera, visible, found, options)
    radius_m = _radius_m(camera, world_from_camera, neighbourhood, visible, found, options)
    serving = np.bincount(visible.reference, weights=found, minlength=len(neighbourhood.references))
    names = [neighbourhood.references[i].name for i in np.argsort(-serving, kind="stable") if serving[i] >= 1]
    verdict, reason = _judge(expected, share, radius_m, options)
    message = f"{verdict.value.replace('_', ' ')}: {reason}"
    return Coverage(verdict, message, round(expected), share, radius_m, tuple(names))


def _probability(visible: Visible, options: CoverageOptions) -> Array:
    """Probability (V,) that each visible point is matched."""
    by_turn = np.exp(-((visible.turn_deg / options.turn_deg) ** 2))
    return np.asarray(options.repeatability * by_turn * np.exp(-np.log(visible.scale) / options.log_scale))


def _judge(
    expected: float, share: float, radius_m: float | None, options: CoverageOptions
) -> tuple[CoverageVerdict, str]:
    matches = f"about {expected:.0f} matches expected in {100 * share:.0f} % of the image"
    if expected < options.least_matches or radius_m is None:
        return CoverageVerdict.NOT_LOCALIZABLE, f"{matches}, {options.least_matches:.0f} are needed"
    reason = f"{matches}, position to {100 * radius_m:.1f} cm"
    if expected < options.enough_matches:
        return CoverageVerdict.DOUBTFUL, f"{reason}; from {options.enough_matches:.0f} matches on one can be sure"
    if share < options.enough_image_share:
        return CoverageVerdict.DOUBTFUL, f"{reason}; they lie in one corner"
    if radius_m > options.max_radius_m:
        return CoverageVerdict.DOUBTFUL, f"{reason}, which is more than {options.max_radius_m:g} m"
    return CoverageVerdict.LOCALIZABLE, reason


def _image_share(camera: Camera, visible: Visible, found: Array, options: CoverageOptions) -> float:
    cell = np.floor((visible.pixel + 0.5) / (camera.width_px, camera.height_px) * (options.columns, options.rows))
    index = (cell[:, 1] * options.columns + cell[:, 0]).astype(np.intp)
    by_cell = np.bincount(index, weights=found, minlength=options.columns * options.rows)
    return float((by_cell >= 1).mean())


def _radius_m(
    camera: Camera,
    world_from_camera: RigidTransform,
    neighbourhood: Neighbourhood,
    visible: Visible,
    found: Array,
    options: CoverageOptions,
) -> float | None:
    """Radius that the position error does not exceed in 68 % of cases, metres; points are weighted by probability."""
    if found.sum() < options.least_matches:
        return None
    camera_from_world = world_from_camera.inverse()
    x_in_camera = camera_from_world.apply(neighbourhood.structure.x_in_world[visible.point])
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    by_point = normalize_jacobian(x_in_camera) * focal[:, None]
    jacobian = by_point @ motion_jacobian(x_in_camera)
    in_image = by_point @ camera_from_world.rotation
    spread = np.einsum("mia,mab,mib->m", in_image, neighbourhood.point_covariance[visible.point], in_image) / 2
    weight = found / (options.sigma_px**2 + spread)
    hessian = np.einsum("m,mia,mib->ab", weight, jacobian, jacobian)
    covariance = options.error_inflation**2 * world_covariance(hessian, world_from_camera)
    return accuracy_from_covariance(covariance).position_68_m
