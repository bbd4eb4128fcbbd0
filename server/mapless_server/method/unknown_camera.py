"""The camera of a photograph that came without intrinsics, from its matches with the references.

What is known without the matches are guesses, in order: by EXIF (`engine.cameras`); then the camera of references whose
photographs have the same sides; then the series of pinholes with square pixels, a centred principal point and focal
lengths of a geometric series. For each a pose is found from the matches with triangulated points (P3P in RANSAC), or,
where these are few, from those with single references, too; the score of `pose.relative` compares them, as it does
cameras that may be wrong (`judge.cameras`). The first one is taken that no other scores significantly higher than. Then
pose and focal length together minimize

    sum_i rho(|u_i - pi(f, P, X_i)|^2) + w (ln f - ln f_0)^2 / sigma^2,    rho(s) = c^2 log(1 + s / c^2)

with the guess's standard deviation sigma. A camera of references is improved no further than their focal lengths differ
among each other, unless this differs from it by more than chance: then it is another one.

The adjustment improves it, with principal point and radial distortion, each within its prior, together with the pose:
principal points are off the centre by up to 1.4 % of the width, and the matches show what a wrong one does to a pose.
It finds, too, how much they determine: of a flat wall that is little. That the references' camera fits makes the pose
more accurate, but no more certain: another camera may have the same sides, and a focal length that the photograph does
not tell apart.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, normalize

from .bundle.adjust import LEAST_MATCHES
from .bundle.intrinsics import DOUBTED_SIGMAS, read_as
from .bundle.pose_problem import AdjustOptions
from .bundle.priors import IntrinsicsSigma
from .features.limits import INEXACT_INLIER_PX
from .features.views import PosedView, View
from .judge.cameras import BY_POINTS, LINES, PNP, ScoredCamera
from .optim.optimize import MinimizeOptions, cauchy_cost, cauchy_weight, damped_step, minimize, perturbed, pose_jacobian
from .options import ChosenCamera, IntrinsicsSource
from .pairs.correspond import Correspondences
from .pose.pnp import MIN_MATCHES, ransac
from .pose.relative import Evidence, find_pose
from .pose.two_view_matches import TwoViewMatches
from .significance import is_significant, sigmas_of_gains
from .structure.match import vote
from .structure.structure import StructureOptions, triangulated_structure

UNKNOWN = IntrinsicsSigma(0.3, 0.01, 0.05, is_guess=True)
"""Standard deviations of a camera of which nothing is known: focal lengths of most cameras are within a third of one
another, principal points within 2 % of the width of the centre, and lenses that are not corrected bend the edge by some
per cent. Evidence: unknown-camera."""

OF_REFERENCES = replace(UNKNOWN, is_guess=False)
"""The same for the camera of references that fits: it is as accurate as theirs, but nothing else speaks for it."""

STEPS = MinimizeOptions(AdjustOptions.iterations, AdjustOptions.min_decrease)


@dataclass(frozen=True, eq=False)
class _Matches:
    """The matches of a photograph whose keypoints are as the image shows them, with lens distortion."""

    view: View
    references: Sequence[PosedView]
    lines: TwoViewMatches
    x_in_world: Array
    keypoint: NDArray[np.intp]

    @staticmethod
    def of(view: View, references: Sequence[PosedView], correspondences: Correspondences) -> "_Matches":
        structure = triangulated_structure(references, correspondences, StructureOptions())
        matches = vote(structure, [len(it.view.features) for it in references], correspondences)
        lines = TwoViewMatches.of(view, references, correspondences.query_matches)
        return _Matches(view, references, lines, structure.x_in_world[matches.point], matches.keypoint)

    def evidence(self, camera: Camera) -> Evidence:
        """The matches as read with a camera; without keypoints that it does not see."""
        view = read_as(self.view, camera)
        seen = np.asarray(np.isfinite(view.features.keypoints).all(axis=1))
        lines, points = self.lines.read_as(view), seen[self.keypoint]
        return Evidence(
            view, self.references, lines[seen[lines.keypoint]], self.x_in_world[points], self.keypoint[points]
        )

    def scored(self, camera: Camera) -> ScoredCamera:
        """A camera with the best pose that a brief search finds."""
        evidence, pose = self.evidence(camera), None
        if len(self.x_in_world) < LEAST_MATCHES:
            pose = find_pose(evidence, LINES)
        elif len(evidence.x_in_world) >= MIN_MATCHES:  # through a strong lens few may be seen
            pose = ransac(evidence.points, None, PNP)
        return ScoredCamera.of(camera, evidence, pose)


def choose_camera(
    view: View, references: Sequence[PosedView], correspondences: Correspondences, guesses: Sequence[ChosenCamera]
) -> ChosenCamera | None:
    """The camera of a photograph without intrinsics; None if its matches show none.

    Args:
        view: the photograph, read as a pinhole's; its camera gives the raster alone.
        references: posed references.
        correspondences: matches between all of them.
        guesses: cameras that it may have by its EXIF, the likeliest first, in pixels of the view.
    """
    if len(references) < 2:
        return guesses[0] if guesses else None
    matches = _Matches.of(view, references, correspondences)
    options = [*guesses, *_of_references(view, references), *_series(view.camera)]
    scored = [matches.scored(it.camera) for it in options]
    best = max(scored, key=lambda it: it.total)
    if best.pose is None:
        return None
    is_as_good = [not is_significant(sigmas_of_gains(best.scores - it.scores), len(options)) for it in scored]
    chosen, found = options[is_as_good.index(True)], scored[is_as_good.index(True)]
    prior = (chosen.sigma or IntrinsicsSigma()).focal_share
    log_ratio, sigma = _improved(matches, found, prior)
    if chosen.source is not IntrinsicsSource.SCENE_CAMERA:
        return replace(chosen, camera=scaled(chosen.camera, log_ratio))
    if abs(log_ratio) >= DOUBTED_SIGMAS * sigma:  # then it is another camera
        estimated = scaled(chosen.camera, log_ratio)
        return ChosenCamera(estimated, UNKNOWN, IntrinsicsSource.ESTIMATED)
    spread = float(np.std([np.log(it.focal_x_px) for it in _cameras_of(view.camera, references)]))
    return replace(chosen, camera=scaled(chosen.camera, log_ratio * spread**2 / (spread**2 + sigma**2)))


def _of_references(view: View, references: Sequence[PosedView]) -> Sequence[ChosenCamera]:
    camera = camera_of_references(view.camera, references)
    return [replace(camera, sigma=OF_REFERENCES)] if camera else ()


def camera_of_references(raster: Camera, references: Sequence[PosedView]) -> ChosenCamera | None:
    """The camera of references of one camera, of which some have a raster of the same sides; None if none has.

    That of the median focal length. If these differ by more than usual, as those of a reconstruction that refines each
    photograph's own, none is exact for another photograph.
    """
    cameras, usual = _cameras_of(raster, references), IntrinsicsSigma().focal_share
    if not cameras:
        return None
    is_one = cameras[-1].focal_x_px <= (1 + 2 * usual) * cameras[0].focal_x_px
    return ChosenCamera(cameras[len(cameras) // 2], None if is_one else OF_REFERENCES, IntrinsicsSource.SCENE_CAMERA)


def _cameras_of(raster: Camera, references: Sequence[PosedView]) -> list[Camera]:
    """The cameras of references whose photographs have the same sides, resized to a raster, by their focal length."""
    cameras = list[Camera]()
    for it in references:
        camera = it.view.photograph.camera if it.view.photograph else it.view.camera
        if abs(camera.width_px * raster.height_px - raster.width_px * camera.height_px) <= camera.width_px:
            cameras.append(camera.resized(raster.width_px, raster.height_px))
    return sorted(cameras, key=lambda it: it.focal_x_px)


def _series(camera: Camera) -> Iterator[ChosenCamera]:
    """Pinholes with focal lengths of 0.4 to 6 longer sides (100 to 10 degrees): first the usual 1.2, then near it."""
    width_px, height_px = camera.width_px, camera.height_px
    for step in sorted(range(-BY_POINTS.focal, 2 * BY_POINTS.focal + 1), key=lambda it: abs(it - 1)):
        centred = Camera.centred(width_px, height_px, max(width_px, height_px) * 2.0 ** (step / BY_POINTS.per_octave))
        yield ChosenCamera(centred, UNKNOWN, IntrinsicsSource.ESTIMATED)


def _improved(matches: _Matches, found: ScoredCamera, prior: float) -> tuple[float, float]:
    """The most probable logarithm of the ratio of the focal length to that of the camera, by the points near its pose.

    Also its standard deviation; 0 and infinity where the points are too few. `prior` is that without the photograph.
    """
    camera, pose = found.camera, found.pose
    log_ratio, sigma = 0.0, np.inf
    for _ in range(2):  # which points are near at a pose of a camera that is a step off
        if pose is None:
            break
        evidence = matches.evidence(scaled(camera, log_ratio))
        near = np.nan_to_num(evidence.points.errors_px(pose), nan=np.inf) < INEXACT_INLIER_PX
        if near.sum() < LEAST_MATCHES:
            break
        pixels = matches.view.features.pixels(evidence.keypoint[near])
        problem = _Focal(camera, pixels, evidence.x_in_world[near], prior)
        log_ratio, camera_from_world = minimize(problem, (log_ratio, pose.inverse()), STEPS)
        variance = np.linalg.pinv(problem.linearize((log_ratio, camera_from_world))[0], hermitian=True)[6, 6]
        pose, sigma = camera_from_world.inverse(), AdjustOptions.error_inflation * float(np.sqrt(variance))
    return log_ratio, sigma


def scaled(camera: Camera, log_ratio: float) -> Camera:
    """The camera with other focal lengths, by the logarithm of their ratio to its own."""
    ratio = float(np.exp(log_ratio))
    return replace(camera, focal_x_px=ratio * camera.focal_x_px, focal_y_px=ratio * camera.focal_y_px)


@dataclass(frozen=True, eq=False)
class _Focal:
    """The cost and its derivatives by the pose and the logarithm of the focal length; see `optimize.Problem`.

    A point is its logarithm by that of the camera, and camera_from_world. Pixels (N, 2) are as the image shows them.
    """

    camera: Camera
    pixels: Array
    x_in_world: Array
    sigma: float

    def cost(self, x: tuple[float, RigidTransform]) -> float:
        """Cost at a point; NaN if a point in the world is behind the camera."""
        log_ratio, camera_from_world = x
        residual = scaled(self.camera, log_ratio).project(camera_from_world.apply(self.x_in_world)) - self.pixels
        prior = AdjustOptions.error_inflation**2 * (log_ratio / self.sigma) ** 2
        return cauchy_cost((residual**2).sum(axis=1), AdjustOptions.loss_scale_sigma) + prior

    def linearize(self, x: tuple[float, RigidTransform]) -> tuple[Array, Array]:
        """Half the cost's information (7, 7) and gradient (7,): of the left perturbation, and of the logarithm."""
        log_ratio, camera_from_world = x
        camera, x_in_camera = scaled(self.camera, log_ratio), camera_from_world.apply(self.x_in_world)
        projected = camera.project(x_in_camera)
        residual = projected - self.pixels
        by_pose = np.moveaxis(pose_jacobian(camera.pinhole(), x_in_camera), -1, 0)
        if camera.distortion is not None:
            by_pose = camera.distortion.by_ideal(normalize(x_in_camera)) @ by_pose
        by_focal = projected - (camera.principal_x_px, camera.principal_y_px)
        jacobian = np.concatenate([by_pose, by_focal[:, :, None]], axis=2)
        weight = cauchy_weight((residual**2).sum(axis=1), AdjustOptions.loss_scale_sigma)
        information = np.einsum("n,nai,naj->ij", weight, jacobian, jacobian)
        gradient = np.einsum("n,nai,na->i", weight, jacobian, residual)
        prior = AdjustOptions.error_inflation**2 / self.sigma**2
        information[6, 6] += prior
        gradient[6] += prior * log_ratio
        return information, gradient

    def step(
        self, x: tuple[float, RigidTransform], equations: tuple[Array, Array], damping: float
    ) -> tuple[float, RigidTransform] | None:
        """The point after a step; None where it is not determined."""
        step = damped_step(*equations, damping)
        return None if step is None else (x[0] + float(step[6]), perturbed(x[1], step[:6]))
