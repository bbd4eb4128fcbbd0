"""The cost of a group of photographs and its derivatives; see `joint`."""

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless.provenance import ADOPTED

from ..bundle.bundle import BundleProblem, free_problem
from ..bundle.normal_equations import Bundle, Linearized, NormalEquations, Poses
from ..bundle.pose_problem import AdjustOptions, most_probable, pose_errors, with_intrinsics
from ..bundle.priors import Priors
from ..bundle.stated import common_motion
from ..features.tracks import Tracks
from ..features.views import PosedView
from ..optim.optimize import LEAST_DAMPING, solve_step, world_jacobian
from ..pose.with_priors import MAX_MATCHES
from ..structure.model import PointMatches
from ..structure.structure import tracks_with_query
from .images import MatchedImage

S = TypeVar("S", bound="GroupState")

ADJUST = AdjustOptions()
"""Options as for one photograph."""


class GroupState(Protocol):
    """The poses of a group as values of N parameters, which may have a cost of their own."""

    @property
    def size(self) -> int:
        """The number N of parameters."""
        ...

    def camera_from_world(self, image: int) -> RigidTransform:
        """Pose of one photograph."""
        ...

    def jacobian(self, image: int) -> Array:
        """Derivative (6, N) of the left perturbation (v, w) of a photograph's camera_from_world by the parameters."""
        ...

    def moved(self: S, step: Array) -> S:
        """Returns the state after a step (N,) of the parameters."""
        ...

    def relaxed(self: S) -> S:
        """Returns the same poses with the cost's standard deviations enlarged to the observed errors."""
        return self

    def cost(self) -> float:
        """The cost of the parameters, without that of the observations."""
        return 0.0

    def equations(self) -> tuple[Array, Array]:
        """Returns J^T J (N, N) and J^T r (N,) of this cost."""
        return np.zeros((self.size, self.size)), np.zeros(self.size)


@dataclass(frozen=True, eq=False)
class Part:
    """The points and tracks of one photograph that are used.

    Attributes:
        source: the photograph.
        world_from_camera: its initial pose.
        chosen: (P_b,) indices of the points of its structure that it is matched with.
        tracks: tracks of these points over its references and, last, the photograph itself.
    """

    source: MatchedImage
    world_from_camera: RigidTransform
    chosen: NDArray[np.intp]
    tracks: Tracks


def part_of(source: MatchedImage, matches: PointMatches, state: GroupState) -> Part:
    """Selects the part of a photograph from its matches with small errors, evenly thinned."""
    structure, pose = source.structure, state.camera_from_world(source.image).inverse()
    errors_px = matches.seen(source.query, structure.x_in_world).errors_px(pose)
    used = np.flatnonzero(errors_px < ADJUST.max_error_px)
    used = used[:: max(1, -(-len(used) // MAX_MATCHES))]
    tracks, chosen = tracks_with_query(structure, matches.point[used], matches.keypoint[used], len(source.references))
    return Part(source, pose, np.flatnonzero(chosen), tracks)


def times_used(parts: Sequence[Part]) -> list[Array]:
    """How often the measured keypoint of each observation (O,) of each part is used in the whole group."""
    measured = [_measurements(part) for part in parts]
    times = Counter(itertools.chain.from_iterable(measured))
    return [np.array([times[it] for it in its], np.float64) for its in measured]


def _measurements(part: Part) -> list[object]:
    """Identity of each observation: its photograph and keypoint."""
    source = part.source
    keypoints = [it.features.keypoints for it in (*(r.view for r in source.references), source.query)]
    # The query is named by its keypoints: a photograph that was sent twice is one measurement.
    names = [*(r.key for r in source.references), keypoints[-1].tobytes()]
    rows = zip(part.tracks.view.tolist(), part.tracks.keypoint.tolist(), strict=True)
    return [(names[v], *keypoints[v][k].tolist()) for v, k in rows]


@dataclass(frozen=True, eq=False)
class ImageBlock:
    """One photograph's part of the problem: as in `adjust`, without the prior, which the group has.

    Attributes:
        source: the photograph.
        chosen: (P_b,) indices of its points in the photograph's structure.
        problem: the cost and its derivatives.
        references: (V - 1,) index of each of its references in the group; the last camera is the photograph.
        level_px: noise of its structure, pixels.
        depth_m: median depth of its points, metres.
    """

    source: MatchedImage
    chosen: NDArray[np.intp]
    problem: BundleProblem
    references: NDArray[np.intp]
    level_px: float
    depth_m: float

    def columns(self, reference_count: int, state: GroupState) -> Array:
        """Derivative (6 V, 6 R + N) of its cameras' motions by the unknowns of the group."""
        local = len(self.references)
        columns = np.zeros((6 * local + 6, 6 * reference_count + state.size))
        for row, reference in enumerate(self.references):
            columns[6 * row : 6 * row + 6, 6 * reference : 6 * reference + 6] = np.eye(6)
        columns[-6:, 6 * reference_count :] = state.jacobian(self.source.image)
        return columns


@dataclass(frozen=True, eq=False)
class Point(Generic[S]):
    """Values of the unknowns: references (R), points of each block (P_b, 3), and the group's state."""

    references: Poses
    points: tuple[Array, ...]
    state: S

    def bundle(self, index: int, block: ImageBlock) -> Bundle:
        """Returns the values of one block."""
        last = self.state.camera_from_world(block.source.image)
        return Bundle(self.references[block.references].and_last(last), self.points[index])

    def at(self, index: int, block: ImageBlock) -> Linearized:
        """Returns the values of one block, linearized."""
        return block.problem.at(self.bundle(index, block))


class GroupProblem(Generic[S]):
    """The cost of a group and its derivatives; see `optimize.Problem`.

    Attributes:
        start: the initial values.
        blocks: one for each photograph with matches.
        priors: priors on the photographs' poses, by index.
    """

    def __init__(
        self,
        matched_images: Sequence[MatchedImage],
        matches: Sequence[PointMatches],
        state: S,
        priors: Mapping[int, Priors] | None = None,
    ) -> None:
        self.priors = priors or {}
        self._references: dict[str, tuple[int, PosedView]] = {}
        parts = [part_of(source, its, state) for source, its in zip(matched_images, matches, strict=True)]
        parts = [part for part in parts if len(part.chosen)]
        self.blocks = [self._block(part, times) for part, times in zip(parts, times_used(parts), strict=True)]
        points = [part.source.structure.x_in_world[part.chosen] for part in parts]
        references = Poses.of(reference.world_from_camera for _, reference in self._references.values())
        self.start = Point(references, tuple(points), state)
        self.information = self._reference_information() if self.blocks else np.zeros((0, 0))

    @property
    def reference_count(self) -> int:
        """Number of different references of all photographs."""
        return len(self._references)

    def _block(self, part: Part, times: Array) -> ImageBlock:
        source, structure = part.source, part.source.structure
        views = [*source.references, PosedView("", "", source.query, part.world_from_camera)]
        loss_scale = ADJUST.loss_scale_sigma
        problem, _, depth_m = free_problem(part.tracks, views, structure, part.chosen, loss_scale, times_used=times)
        known = self._references
        references = np.array([known.setdefault(it.key, (len(known), it))[0] for it in source.references])
        return ImageBlock(source, part.chosen, problem, references, structure.noise.level_px, depth_m)

    def _reference_information(self) -> Array:
        """Inverse covariance (6 R, 6 R) of the priors on the references' poses (see `pose_problem`).

        The size of the errors is estimated from the photograph with the most observations; they are relative to the
        place of the last photograph.
        """
        index = max(range(len(self.blocks)), key=lambda i: len(self.blocks[i].problem.by_view.view))
        block, given = self.blocks[index], self.start.references
        bundle = self.start.bundle(index, block)
        observing = np.unique(block.problem.by_view.view)[:-1]  # the last is the photograph
        views = [reference.view for _, reference in self._references.values()]
        focal_px = float(np.median([views[i].camera.focal_x_px for i in block.references[observing]]))
        size = block.level_px, focal_px, block.depth_m
        centre = bundle.world_from_query.translation
        its = given[block.references]
        stated = [reference.provenance for _, reference in self._references.values()]
        its_stated = [stated[i] for i in block.references]
        errors = pose_errors(its.centres, its.rotation, centre, *size, observing, its_stated)
        matrix, gradient, _ = block.problem.linearize(block.problem.at(bundle)).reduced(LEAST_DAMPING)
        own, drift = most_probable(errors, matrix, gradient)
        last = self.start.state.camera_from_world(self.blocks[-1].source.image).inverse().translation
        errors = pose_errors(given.centres, given.rotation, last, *size, block.references[observing], stated)
        return np.asarray(np.linalg.inv(errors.covariance(own, drift)), np.float64)

    def cost(self, point: Point[S]) -> float:
        """Cost of a point of the search; NaN if a structure point is behind a camera."""
        data = sum(block.problem.cost(point.at(i, block)) for i, block in enumerate(self.blocks))
        poses = {image: point.state.camera_from_world(image).inverse() for image in self.priors}
        prior = sum(self.priors[image].cost(pose) for image, pose in poses.items())
        motion = self._reference_motion(point)
        return data + float(motion @ self.information @ motion) + point.state.cost() + ADJUST.error_inflation**2 * prior

    def _reference_motion(self, point: Point[S]) -> Array:
        """Motion (6 R,) of each reference from its given pose."""
        return point.references.motion_from(self.start.references).ravel()

    def linearize(self, point: Point[S]) -> list[NormalEquations]:
        """See `optimize.Problem`."""
        return [block.problem.linearize(point.at(i, block)) for i, block in enumerate(self.blocks)]

    def _columns(self, point: Point[S]) -> list[Array]:
        return [block.columns(self.reference_count, point.state) for block in self.blocks]

    def step(self, point: Point[S], equations: Sequence[NormalEquations], damping: float) -> Point[S] | None:
        """See `optimize.Problem`."""
        columns = self._columns(point)
        reduced = [it.reduced(damping) for it in equations]
        matrix, gradient = self._prior_equations(point, ADJUST.error_inflation**2)
        matrix += damping * np.diag(np.diag(matrix))
        for (its_matrix, its_gradient, _), its_columns in zip(reduced, columns, strict=True):
            matrix += its_columns.T @ its_matrix @ its_columns
            gradient += its_columns.T @ its_gradient
        # The least-norm step does not move an unobserved parameter (of a photograph without matches and cost).
        step = solve_step(matrix, gradient, least_norm=True)
        if step is None:
            return None
        points = []
        for i, ((_, _, eliminated), its_columns) in enumerate(zip(reduced, columns, strict=True)):
            centre = point.state.camera_from_world(self.blocks[i].source.image).inverse().translation
            points.append(_stepped(point.points[i], eliminated.steps(its_columns @ step), centre))
        references = point.references.moved(step[: 6 * self.reference_count].reshape(-1, 6))
        return Point(references, tuple(points), point.state.moved(step[6 * self.reference_count :]))

    def _prior_equations(
        self, point: Point[S], prior_weight: float = 1.0, data_inflation: float = 1.0
    ) -> tuple[Array, Array]:
        """Matrix and gradient of the priors of references and photographs, and of the parameters' cost."""
        references = 6 * self.reference_count
        matrix = np.zeros((references + point.state.size,) * 2)
        gradient = np.zeros(len(matrix))
        matrix[:references, :references] = self.information / data_inflation**2
        gradient[:references] = self.information @ self._reference_motion(point) / data_inflation**2
        matrix[references:, references:], gradient[references:] = point.state.equations()
        for image, priors in self.priors.items():
            pose, columns = point.state.camera_from_world(image).inverse(), point.state.jacobian(image)
            slope, information = priors.gradient_and_information(pose)
            by_state = world_jacobian(pose) @ columns
            matrix[references:, references:] += prior_weight * by_state.T @ information @ by_state
            gradient[references:] += prior_weight * by_state.T @ slope
        return matrix, gradient

    def covariance(self, point: Point[S]) -> Array:
        """Covariance (N, N) of the parameters; infinite on the diagonal for unobserved ones.

        The standard deviations of the observations are inflated (see AdjustOptions.error_inflation), those of the
        priors and of the parameters' cost are not. What adopted references are off in common is added (see `stated`).
        """
        inflation = ADJUST.error_inflation
        matrix, _ = self._prior_equations(point, data_inflation=inflation)
        for it, its_columns in zip(self.linearize(point), self._columns(point), strict=True):
            its_matrix, _, _ = it.reduced(0.0)
            matrix += its_columns.T @ its_matrix @ its_columns / inflation**2
        references = 6 * self.reference_count
        coupling = matrix[:references, references:]
        hessian = matrix[references:, references:]
        if references:
            hessian = hessian - coupling.T @ np.linalg.solve(matrix[:references, :references], coupling)
        inverse = _inverse(hessian)
        covariance = inverse
        for by_errors, variances in self._by_intrinsics(point):
            gradient = by_errors[references:] / inflation**2
            if references:
                known = np.linalg.solve(matrix[:references, :references], by_errors[:references] / inflation**2)
                gradient = gradient - coupling.T @ known
            motion = inverse @ gradient
            covariance = covariance + (motion * variances) @ motion.T
        its = [reference for _, reference in self._references.values()]
        if any(it.provenance.source == ADOPTED for it in its):
            held = self.information @ common_motion(its) / inflation**2
            by_common = inverse @ coupling.T @ np.linalg.solve(matrix[:references, :references], held)
            covariance = covariance + by_common @ by_common.T
        return covariance

    def _by_intrinsics(self, point: Point[S]) -> Iterator[tuple[Array, Array]]:
        """For each camera whose intrinsics are uncertain: derivatives (U, 4) of the gradient by their errors.

        Also the variances (4,) of these. Photographs of equal intrinsics and uncertainty have the same errors.
        """
        cameras = defaultdict[object, list[int]](list)
        for i, block in enumerate(self.blocks):
            if block.source.intrinsics_sigma is not None:
                query = block.source.query
                cameras[query.camera, query.distortion, block.source.intrinsics_sigma].append(i)
        for indices in cameras.values():
            total = np.zeros((6 * self.reference_count + point.state.size, 4))
            for i in indices:
                block = self.blocks[i]
                wider, bundle = with_intrinsics(block.problem, point.bundle(i, block), block.source.query)
                matrix, _, _ = wider.linearize(wider.at(bundle)).reduced(0.0)
                columns = block.columns(self.reference_count, point.state)
                total += columns.T @ matrix[: len(columns), len(columns) :]
            source = self.blocks[indices[0]].source
            assert source.intrinsics_sigma is not None
            yield total, source.intrinsics_sigma.of(source.query.camera) ** 2


def _stepped(points: Array, steps: Array, centre: Array) -> Array:
    """Moves points (P, 3) by steps (P, 3), none longer than half the point's distance to a camera.

    The point of a wrong match, whose weight vanishes, would otherwise diverge until the system is singular.
    """
    longest = np.linalg.norm(points - centre, axis=1) / 2
    length = np.linalg.norm(steps, axis=1)
    return np.asarray(points + steps * np.minimum(1.0, longest / np.maximum(length, 1e-12))[:, None])


def _inverse(hessian: Array) -> Array:
    """Inverts a symmetric matrix; the result is very large in its null space, where a pseudo-inverse would be zero."""
    if not np.isfinite(hessian).all():
        return np.full(hessian.shape, np.inf)
    unit = np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    values, vectors = np.linalg.eigh(hessian / np.outer(unit, unit))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(inverse / np.outer(unit, unit))
