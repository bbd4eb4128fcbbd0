"""The cost of a group of photographs, and how it is minimized; see `joint`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Generic

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ..adjust import AdjustOptions, _NormalEquations, _Problem, _State
from ..match import PointMatches
from ..structure import observe
from ..views import PosedView
from .freedom import F, Freedom
from .parts import Part, Shared, part_of
from .sightings import Sighting


@dataclass(frozen=True)
class JointOptions:
    """Options of the joint adjustment.

    Attributes:
        adjust: as for one photograph.
        max_matches: of a photograph, evenly thinned; several photographs have plenty together.
        iterations: at most so many Levenberg-Marquardt steps; drift takes more than one photograph's pose.
    """

    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    max_matches: int = 300
    iterations: int = 15

    def __post_init__(self) -> None:
        if self.max_matches < 3 or self.iterations < 1:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True, eq=False)
class Block:
    """One photograph's part of the problem: `adjust`'s, without the prior, which is the group's.

    Attributes:
        image: which of the group's.
        problem: the cost and its derivatives.
        references: (V - 1,) which of the group's references its cameras are; the last camera is the photograph.
    """

    image: int
    problem: _Problem
    references: NDArray[np.intp]

    def columns(self, reference_count: int, freedom: Freedom) -> Array:
        """(6 V, 6 R + N): the motions of its cameras by the unknowns of the group."""
        local = len(self.references)
        columns = np.zeros((6 * local + 6, 6 * reference_count + freedom.size))
        for row, reference in enumerate(self.references):
            columns[6 * row : 6 * row + 6, 6 * reference : 6 * reference + 6] = np.eye(6)
        columns[-6:, 6 * reference_count :] = freedom.jacobian(self.image)
        return columns


@dataclass(frozen=True, eq=False)
class Point(Generic[F]):
    """Where the search for the optimum is: references (R), points of each block (P_b, 3), and the group's freedom."""

    rotation: Array
    translation: Array
    points: tuple[Array, ...]
    freedom: F

    def state(self, index: int, block: Block) -> _State:
        """Of one block."""
        last = self.freedom.camera_from_world(block.image)
        return _State(
            np.concatenate([self.rotation[block.references], last.rotation[None]]),
            np.concatenate([self.translation[block.references], last.translation[None]]),
            self.points[index],
        )


class GroupProblem(Generic[F]):
    """The cost of a group and its derivatives.

    Attributes:
        start: where it begins.
        blocks: one for each photograph that takes part.
        chosen: of each block, which (P_b,) of the photograph's points these are.
    """

    def __init__(
        self,
        sightings: Sequence[Sighting],
        matches: Sequence[PointMatches],
        freedom: F,
        options: JointOptions,
    ) -> None:
        self.options = options
        self._references: dict[str, tuple[int, PosedView]] = {}
        self._prior_sigma: list[Array] = []
        self.blocks: list[Block] = []
        self.chosen: list[NDArray[np.intp]] = []
        points: list[Array] = []
        parts = [
            part_of(sighting, its_matches, freedom, options.adjust.max_error_px, options.max_matches)
            for sighting, its_matches in zip(sightings, matches, strict=True)
        ]
        taking_part = [part for part in parts if len(part.chosen)]
        shared = Shared(taking_part)
        for part in taking_part:
            self.chosen.append(part.chosen)
            points.append(part.sighting.structure.x_in_world[part.chosen])
            self.blocks.append(self._block(part, shared))
        given = [reference.world_from_camera.inverse() for _, reference in self._references.values()]
        self.information = np.concatenate([np.ravel(sigma) for sigma in self._prior_sigma] or [np.empty(0)]) ** -2.0
        self.start = Point(
            np.stack([it.rotation for it in given]) if given else np.empty((0, 3, 3)),
            np.stack([it.translation for it in given]) if given else np.empty((0, 3)),
            tuple(points),
            freedom,
        )

    @property
    def reference_count(self) -> int:
        """References of all photographs, each counted once."""
        return len(self._references)

    def _block(self, part: Part, shared: Shared) -> Block:
        sighting, structure = part.sighting, part.sighting.structure
        views = [*sighting.references, PosedView("", "", sighting.query, part.world_from_camera)]
        observations = observe(part.tracks, views, structure.noise)
        observations = replace(observations, sigma_px=observations.sigma_px * np.sqrt(shared.times(part)))
        camera_from_world = [it.world_from_camera.inverse() for it in views]
        state = _State(
            np.stack([c.rotation for c in camera_from_world]),
            np.stack([c.translation for c in camera_from_world]),
            structure.x_in_world[part.chosen],
        )
        depth_m = float(np.nanmedian(observations.in_camera(state.points)[:, 2]))
        references = np.array([self._index(it, structure.noise.level_px, depth_m) for it in sighting.references])
        no_prior = np.full((len(sighting.references), 6), np.inf)
        problem = _Problem(observations, part.tracks.view, state, no_prior, self.options.adjust)
        return Block(sighting.image, problem, references)

    def _index(self, reference: PosedView, level_px: float, depth_m: float) -> int:
        """Which of the group's references it is; a new one is held to its pose as `adjust` does."""
        if reference.key not in self._references:
            self._references[reference.key] = (len(self._references), reference)
            # Noise of a pixel is a turn of 1 / f, or a shift of depth / f.
            turn = self.options.adjust.prior_share * level_px / reference.view.camera.focal_x_px
            self._prior_sigma.append(np.repeat([turn * depth_m, turn], 3))
        return self._references[reference.key][0]

    def cost(self, point: Point[F]) -> float:
        """NaN for a point behind a camera."""
        data = sum(block.problem.cost(point.state(i, block)) for i, block in enumerate(self.blocks))
        return data + float((self._prior_error(point) ** 2 * self.information).sum()) + point.freedom.cost()

    def _prior_error(self, point: Point[F]) -> Array:
        """(6 R,): the motion of each reference away from its given pose."""
        turn = point.rotation @ np.swapaxes(self.start.rotation, 1, 2)
        shift = point.translation - (turn @ self.start.translation[:, :, None])[..., 0]
        skew = (turn - np.swapaxes(turn, 1, 2)) / 2
        return np.asarray(np.concatenate([shift, skew[:, [2, 0, 1], [1, 2, 0]]], axis=1).ravel())

    def _linearize(self, point: Point[F]) -> list[_NormalEquations]:
        return [block.problem.linearize(point.state(i, block)) for i, block in enumerate(self.blocks)]

    def _columns(self, point: Point[F]) -> list[Array]:
        return [block.columns(self.reference_count, point.freedom) for block in self.blocks]

    def _step(self, point: Point[F], equations: Sequence[_NormalEquations], damping: float) -> Point[F]:
        """Where one Levenberg-Marquardt step leads."""
        columns = self._columns(point)
        reduced = [it.reduced(damping) for it in equations]
        matrix, gradient = self._held(point)
        matrix += damping * np.diag(np.diag(matrix))
        for (its_matrix, its_gradient, _), its_columns in zip(reduced, columns, strict=True):
            matrix += its_columns.T @ its_matrix @ its_columns
            gradient += its_columns.T @ its_gradient
        # A parameter that nothing tells (a photograph without matches, before anything holds it) stays.
        step = -np.asarray(np.linalg.lstsq(matrix, gradient, rcond=None)[0], np.float64)
        points = []
        for i, (it, (_, _, inverse), its_columns) in enumerate(zip(equations, reduced, columns, strict=True)):
            back = it.point_gradient + np.swapaxes(it.cross, 1, 2) @ (its_columns @ step)
            centre = point.freedom.camera_from_world(self.blocks[i].image).inverse().translation
            points.append(_stepped(point.points[i], -(inverse @ back[:, :, None])[..., 0], centre))
        motion = step[: 6 * self.reference_count].reshape(-1, 6)
        moved = _State(point.rotation, point.translation, np.empty((0, 3))).moved(motion, np.empty((0, 3)))
        freedom = point.freedom.moved(step[6 * self.reference_count :])
        return Point(moved.rotation, moved.translation, tuple(points), freedom)

    def _held(self, point: Point[F], data_inflation: float = 1.0) -> tuple[Array, Array]:
        """Matrix and gradient of all that is no observation."""
        references = 6 * self.reference_count
        matrix = np.zeros((references + point.freedom.size,) * 2)
        gradient = np.zeros(len(matrix))
        matrix[range(references), range(references)] = self.information / data_inflation**2
        gradient[:references] = self.information * self._prior_error(point) / data_inflation**2
        matrix[references:, references:], gradient[references:] = point.freedom.equations()
        return matrix, gradient

    def minimize(self, point: Point[F]) -> Point[F]:
        """The optimum near a point, by Levenberg-Marquardt."""
        if not self.blocks:
            return point
        cost, damping = self.cost(point), 1e-4
        equations = self._linearize(point)
        for _ in range(self.options.iterations):
            candidate = self._step(point, equations, damping)
            candidate_cost = self.cost(candidate)
            if not candidate_cost < cost:
                damping *= 10
                continue
            converged = cost - candidate_cost < self.options.adjust.min_decrease * cost
            point, cost, damping = candidate, candidate_cost, damping * 0.1
            equations = self._linearize(point)
            if converged:
                break
        return point

    def covariance(self, point: Point[F]) -> Array:
        """(N, N) of the freedom's parameters; infinite on the diagonal where nothing tells them.

        What holds the photographs together is believed as it is said, the observations less than they say (see
        AdjustOptions.error_inflation).
        """
        inflation = self.options.adjust.error_inflation
        matrix, _ = self._held(point, inflation)
        for it, its_columns in zip(self._linearize(point), self._columns(point), strict=True):
            its_matrix, _, _ = it.reduced(0.0)
            matrix += its_columns.T @ its_matrix @ its_columns / inflation**2
        references = 6 * self.reference_count
        coupling = matrix[:references, references:]
        hessian = matrix[references:, references:]
        if references:
            hessian = hessian - coupling.T @ np.linalg.solve(matrix[:references, :references], coupling)
        return _inverse(hessian)


def _stepped(points: Array, steps: Array, centre: Array) -> Array:
    """Points (P, 3) after steps (P, 3), none longer than half its distance to a camera.

    A wrong match whose weight vanishes lets its point flee to where nothing can be solved any more.
    """
    longest = np.linalg.norm(points - centre, axis=1) / 2
    length = np.linalg.norm(steps, axis=1)
    return np.asarray(points + steps * np.minimum(1.0, longest / np.maximum(length, 1e-12))[:, None])


def _inverse(hessian: Array) -> Array:
    """Of a symmetric matrix; huge in directions that it does not hold, not zero as a pseudo-inverse would be."""
    if not np.isfinite(hessian).all():
        return np.full(hessian.shape, np.inf)
    unit = np.sqrt(np.maximum(np.diag(hessian), 1e-12))
    values, vectors = np.linalg.eigh(hessian / np.outer(unit, unit))
    inverse = (vectors / np.maximum(values, 1e-12)) @ vectors.T
    return np.asarray(inverse / np.outer(unit, unit))
