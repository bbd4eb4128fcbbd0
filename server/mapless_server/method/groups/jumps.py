"""Jumps of a device's tracking: steps of its session that the photographs contradict.

A device that relocalizes or loses its tracking moves its session at once. Where two photographs are localized alone,
the step between their poses is compared with the tracked one: the difference e, of position and rotation, has a
covariance from the poses' own and from the drift of the steps between. A pair with

    m^2 = e^T C^-1 e > conflict_threshold(6)

contradicts the tracking. Either it has jumped, or one of the two poses is wrong. So a chain of poses from the first to
the last is found that has the least cost: m^2 for each link, at most the threshold, at which it is cut; and more than
that for each pose left out. A pose that contradicts both its neighbours, which agree with each other, is left out; any
other contradiction is a jump. The last pose is never left out: the answer follows its photograph.

If the session's unit is unknown, the chain of least cost over the units that all pairs give is used. A step that is a
jump gives a unit, too, in which the others are jumps; where such a chain costs hardly more, the jump is uncertain.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, cross_matrix

from ..bundle.priors import conflict_threshold
from ..optim.rotations import rotation_vector
from .drift import step_sigma, step_size


@dataclass(frozen=True)
class Jump:
    """A jump of the tracking.

    Attributes:
        before: index of the last photograph before it.
        after: index of the first one after it. Photographs between them have too few matches: it is not known at which
            of these the tracking has jumped, and their poses may be on the wrong side of it.
        shift_m: distance of the tracked position after the jump from that of the photographs, metres.
        rotation_deg: the angle between the two orientations.
    """

    before: int
    after: int
    shift_m: float
    rotation_deg: float

    def described(self, unit: str) -> str:
        """One sentence about it; `unit` is the scene's unit of length."""
        return (
            f"the tracking jumps by {self.shift_m:.2f} {unit} and {self.rotation_deg:.1f} degrees between "
            f"frames[{self.before}] and frames[{self.after}]"
        )


OWN_INFLATION = 2.0
"""Factor on the standard deviations of the photographs' own poses, which errors exceed in unseen places."""

LEFT_OUT_COST = 1.5
"""Cost of leaving out a pose, in thresholds; more than one jump and less than two."""

ALL_JUMPS = 3
"""Where so many steps or more are all jumps, the tracked poses are wrong; fewer may be jumps of a device."""

UNIT_STEP = 1.005
"""Units that an unknown unit is tried from differ by at least this factor; it is less than drift of 1.2 %."""

OTHER_UNIT = 1.25
"""Factor by which units differ: drift changes the length of a path by some per cent, a wrong unit by more."""

CERTAIN_COST = 0.5
"""The jumps of a session in an unknown unit are certain if chains in other units cost more by so many thresholds."""


@dataclass(frozen=True, eq=False)
class Chain:
    """Photographs whose own poses and the tracking are consistent, except at jumps.

    Attributes:
        frames: indices of the photographs, in order.
        jumps: the jumps between successive ones of them.
        scale: metres per unit of the session; the chain's own estimate where it was unknown.
        cost: sum for the pairs, the jumps and the poses that are left out.
        is_certain: whether the jumps are the same in any unit that the session may have.
    """

    frames: tuple[int, ...]
    jumps: tuple[Jump, ...]
    scale: float
    cost: float
    is_certain: bool = True

    @property
    def places(self) -> set[tuple[int, int]]:
        """The photographs before and after each jump."""
        return {(it.before, it.after) for it in self.jumps}


def find_jumps(
    own: Mapping[int, tuple[RigidTransform, Array]],
    session_from_camera: Sequence[RigidTransform],
    scale: float | None,
) -> Chain | None:
    """Finds the chain of least cost; None if there is no pose, or no unit of the session.

    `own` has world_from_camera and its covariance (6, 6) of each photograph that is localized alone, by its index;
    `session_from_camera` the tracked pose of every photograph. The scale is metres per unit of the session, None if
    unknown.
    """
    if not own:
        return None
    links = _Links.of(own, session_from_camera)
    if scale is not None:
        return _chain(links, scale, is_known=True)
    chains = [_chain(links, it, is_known=False) for it in links.scales()]
    if not chains:
        return None
    best = min(chains, key=lambda it: it.cost)
    return replace(best, is_certain=not best.jumps or _is_certain(best, chains))


def _chain(links: "_Links", scale: float, is_known: bool) -> Chain:
    """The chain of least cost in a unit; of all poses if it is known and all steps, enough of them, are jumps."""
    squared, threshold = links.squared(scale), conflict_threshold(6)
    cost, positions = _cheapest(squared, threshold, LEFT_OUT_COST * threshold)
    steps = squared.diagonal(1)
    if is_known and len(steps) >= ALL_JUMPS and (steps > threshold).all():
        # Leaving poses out would explain some of it by the noise of long steps, as of a session in millimetres.
        positions = list(range(len(squared)))
    jumps = tuple(links.jump(i, j, scale) for i, j in pairwise(positions) if squared[i, j] > threshold)
    return Chain(tuple(links.frames[positions].tolist()), jumps, scale, cost)


def _is_certain(best: Chain, chains: Sequence[Chain]) -> bool:
    """Whether the jumps of the best chain, of those in all units, are the only ones that explain the session."""
    if len(best.jumps) == len(best.frames) - 1:
        return False  # the unit is that of a jump
    limit = best.cost + CERTAIN_COST * conflict_threshold(6)
    return not any(
        it.cost < limit and it.places != best.places and abs(math.log(it.scale / best.scale)) > math.log(OTHER_UNIT)
        for it in chains
    )


def _cheapest(squared: Array, threshold: float, left_out: float) -> tuple[float, list[int]]:
    """Cost and positions of the cheapest chain from the first to the last of N poses, from the m^2 (N, N) of pairs."""
    count = len(squared)
    costs, previous = np.full(count, math.inf), np.full(count, -1)
    costs[0] = 0.0
    for j in range(1, count):
        through = [costs[i] + min(squared[i, j], threshold) + left_out * (j - i - 1) for i in range(j)]
        previous[j] = int(np.argmin(through))
        costs[j] = through[previous[j]]
    chain = [count - 1]
    while chain[-1] > 0:
        chain.append(int(previous[chain[-1]]))
    return float(costs[-1]), chain[::-1]


@dataclass(frozen=True, eq=False)
class _Links:
    """The pairs (i < j) of N own poses, with their differences in the world's axes.

    Attributes:
        frames: (N,) index of the photograph of each.
        first, second: (P,) positions of each pair.
        shift: (P, 3) from the first camera to the second.
        tracked: (P, 3) the same as tracked, in units of the session.
        turn: (P, 3) rotation from the tracked orientation to the photograph's.
        own: (P, 6, 6) covariance of shift and turn that follows from the poses' own.
        steps: (F - 1, 2) length, in the session's unit, and angle, in degrees, of each step of the session.
        levers: (P, F - 1) tracked distance from the end of each step to the second camera; NaN for steps outside the
            pair.
    """

    frames: NDArray[np.intp]
    first: NDArray[np.intp]
    second: NDArray[np.intp]
    shift: Array
    tracked: Array
    turn: Array
    own: Array
    steps: Array
    levers: Array

    @staticmethod
    def of(own: Mapping[int, tuple[RigidTransform, Array]], session: Sequence[RigidTransform]) -> "_Links":
        frames = sorted(own)
        pairs = list(combinations(range(len(frames)), 2))
        shift, tracked, turn, covariances = [], [], [], []
        levers = np.full((len(pairs), len(session) - 1), np.nan)
        for row, (i, j) in enumerate(pairs):
            a, b = frames[i], frames[j]
            (pose, covariance), (other, other_covariance) = own[a], own[b]
            step = session[a].inverse().compose(session[b])
            shift.append(other.translation - pose.translation)
            tracked.append(pose.rotation @ step.translation)
            turn.append(rotation_vector(other.rotation @ (pose.rotation @ step.rotation).T))
            by_first = -np.eye(6)
            by_first[:3, 3:] = cross_matrix(shift[-1])
            covariances.append(by_first @ covariance @ by_first.T + other_covariance)
            for k in range(a, b):
                levers[row, k] = np.linalg.norm(session[b].translation - session[k + 1].translation)
        moves = [first.inverse().compose(second) for first, second in pairwise(session)]
        return _Links(
            np.array(frames),
            np.array([i for i, _ in pairs], np.intp),
            np.array([j for _, j in pairs], np.intp),
            np.array(shift).reshape(-1, 3),
            np.array(tracked).reshape(-1, 3),
            np.array(turn).reshape(-1, 3),
            OWN_INFLATION**2 * np.array(covariances).reshape(-1, 6, 6),
            np.array([step_size(it) for it in moves]).reshape(-1, 2),
            levers,
        )

    def scales(self) -> list[float]:
        """Metres per unit that the pairs give, in order, without those that are nearly the same."""
        travelled, moved_m = np.linalg.norm(self.tracked, axis=1), np.linalg.norm(self.shift, axis=1)
        usable = (travelled > 0) & (moved_m > 0)
        found: list[float] = []
        for scale in np.sort(moved_m[usable] / travelled[usable]).tolist():
            if not found or scale > UNIT_STEP * found[-1]:
                found.append(scale)
        return found

    def squared(self, scale: float) -> Array:
        """The matrix (N, N) of each pair's m^2, above the diagonal."""
        result = np.zeros((len(self.frames),) * 2)
        if not len(self.first):
            return result
        length_m, turn_deg = scale * self.steps[:, 0], self.steps[:, 1]
        sigma_m, angle = step_sigma(length_m, turn_deg)
        inside = np.isfinite(self.levers)
        levers_m = scale * np.where(inside, self.levers, 0.0)
        shift = inside @ sigma_m**2 + levers_m**2 @ angle**2
        covariance = self.own.copy()
        covariance[:, range(3), range(3)] += shift[:, None]
        covariance[:, range(3, 6), range(3, 6)] += (inside @ angle**2)[:, None]
        error = np.concatenate([self.shift - scale * self.tracked, self.turn], axis=1)
        whitened = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
        result[self.first, self.second] = (error * whitened).sum(axis=1)
        return result

    def jump(self, i: int, j: int, scale: float) -> Jump:
        """The difference between two poses, as a jump."""
        row = int(np.flatnonzero((self.first == i) & (self.second == j))[0])
        shift_m = float(np.linalg.norm(self.shift[row] - scale * self.tracked[row]))
        turn_deg = math.degrees(float(np.linalg.norm(self.turn[row])))
        return Jump(int(self.frames[i]), int(self.frames[j]), shift_m, turn_deg)
