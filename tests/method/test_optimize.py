"""The optimizer and its losses: minima against SciPy's, damping, stopping, wrong options."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from scipy import optimize
from support.compare import assert_jacobian
from support.scenes import random_for

from mapless.geometry import Array
from mapless_server.method.arrays import SYMMETRIC
from mapless_server.method.optimize import (
    MinimizeOptions,
    cauchy_cost,
    cauchy_weight,
    damped_step,
    minimize,
    minimize_each,
    soft_l1,
    soft_l1_weight,
    solve_step,
)

least_squares: Any = optimize.least_squares  # mypy takes it for the module of that name
CLOSELY = MinimizeOptions(iterations=200, min_decrease=1e-15)


@dataclass(eq=False)
class Decay:
    """y = a exp(-b t) + c with Cauchy's loss, some of the y being wrong."""

    t: Array
    y: Array
    scale: float
    dampings: list[float] = field(default_factory=list)
    linearized: int = 0

    def residuals(self, x: Array) -> Array:
        return np.asarray(x[0] * np.exp(-x[1] * self.t) + x[2] - self.y)

    def jacobian(self, x: Array) -> Array:
        decay = np.exp(-x[1] * self.t)
        return np.stack([decay, -x[0] * self.t * decay, np.ones_like(self.t)], axis=1)

    def cost(self, x: Array) -> float:
        return cauchy_cost(self.residuals(x) ** 2, self.scale)

    def linearize(self, x: Array) -> tuple[Array, Array]:
        self.linearized += 1
        residuals, jacobian = self.residuals(x), self.jacobian(x)
        weighted = jacobian * cauchy_weight(residuals**2, self.scale)[:, None]
        return weighted.T @ jacobian, weighted.T @ residuals

    def step(self, x: Array, equations: tuple[Array, Array], damping: float) -> Array | None:
        self.dampings.append(damping)
        step = damped_step(*equations, damping)
        return None if step is None else x + step


TRUTH = np.array([3.0, 0.7, 1.0])


def decay(case: object, outlier_share: float = 0.2, count: int = 60) -> Decay:
    random = random_for("decay", case)
    t = random.uniform(0, 5, count)
    y = TRUTH[0] * np.exp(-TRUTH[1] * t) + TRUTH[2] + random.normal(0, 0.05, count)
    y += np.where(random.random(count) < outlier_share, random.normal(0, 2, count), 0)
    return Decay(t, y, 0.1)


@pytest.mark.parametrize("outlier_share", [0.0, 0.2, 0.4])
@pytest.mark.parametrize("off", [0.05, 0.4])
def test_minimum_equals_scipys_with_cauchy_loss(outlier_share: float, off: float) -> None:
    for seed in range(4):
        problem = decay((seed, outlier_share, off), outlier_share)
        start = TRUTH + random_for("start", seed).normal(0, off, 3)
        found = minimize(problem, start, CLOSELY)
        theirs = least_squares(
            problem.residuals, found, problem.jacobian, loss="cauchy", f_scale=0.1, xtol=1e-15, ftol=1e-15, gtol=1e-15
        )
        np.testing.assert_allclose(found, theirs.x, rtol=1e-6)
        assert problem.cost(found) == pytest.approx(2 * theirs.cost, rel=1e-12)
        assert problem.cost(found) < problem.cost(start)


def test_minimum_equals_scipys_with_soft_l1_loss() -> None:
    """Points of a plane by their distances to anchors; what is wrong is wrong for some of them."""
    random, count = random_for("each"), 20
    anchors, truth = random.normal(0, 5, (9, 3)), random.normal(0, 2, (count, 3))
    measured = np.linalg.norm(truth[:, None] - anchors, axis=2) + random.normal(0, 0.02, (count, 9))
    measured[::3, 0] += 1.0

    def residuals(points: Array) -> Array:
        return np.asarray(np.linalg.norm(points[:, None] - anchors, axis=2) - measured)

    def cost(points: Array) -> Array:
        return np.asarray(soft_l1(residuals(points) ** 2, 0.1).sum(axis=1))

    def linearize(points: Array) -> tuple[Array, Array]:
        jacobian = points[:, None] - anchors
        jacobian /= np.linalg.norm(jacobian, axis=2, keepdims=True)
        weight = soft_l1_weight(residuals(points) ** 2, 0.1)
        weighted = np.swapaxes(jacobian * weight[:, :, None], 1, 2)
        hessian = np.stack([(weighted @ jacobian)[:, i, j] for i, j in SYMMETRIC])
        return hessian, (weighted @ residuals(points)[:, :, None])[..., 0].T

    start = truth + random.normal(0, 0.3, truth.shape)
    start[5] = np.nan
    found = minimize_each(lambda it: cost(it.T), lambda it: linearize(it.T), start.T, 60).T
    assert np.isnan(found[5]).all()
    for p in np.delete(np.arange(count), 5):

        def row(x: Array, p: int = int(p)) -> Array:
            return np.asarray(np.linalg.norm(x - anchors, axis=1) - measured[p])

        theirs = least_squares(row, start[p], loss="soft_l1", f_scale=0.1, xtol=1e-14, ftol=1e-14, gtol=1e-14)
        np.testing.assert_allclose(found[p], theirs.x, atol=1e-6)
    np.testing.assert_array_less(np.delete(cost(found), 5), np.delete(cost(start), 5))


def test_steps_that_raise_the_cost_are_damped() -> None:
    """Beside a gross first guess Gauss-Newton's step overshoots; no taken step raises the cost."""
    problem = decay("damped", 0.0)
    options = MinimizeOptions(iterations=200, min_decrease=1e-15, damping=1e-8, raised_by=100.0)
    start = np.array([3.0, 4.0, -1.0])
    found = minimize(problem, start, options)
    np.testing.assert_allclose(found, TRUTH, atol=0.1)
    factors = np.array(problem.dampings[1:]) / problem.dampings[:-1]
    assert set(np.round(factors, 6)) == {0.1, 100.0}
    assert problem.linearized == 1 + int((factors < 1).sum()), "only where a step was taken"


def test_an_undetermined_unknown_does_not_move() -> None:
    """All at one time: a, b and c cannot be distinguished, and the cost decreases all the same."""
    problem = decay("flat", 0.0)
    problem.t = np.full_like(problem.t, 2.0)
    start = TRUTH + [0.5, 0.0, 0.5]
    found = minimize(problem, start, CLOSELY)
    assert np.isfinite(found).all()
    assert problem.cost(found) < problem.cost(start)
    problem.t = np.zeros_like(problem.t)  # the cost does not depend on b
    assert minimize(problem, start, CLOSELY)[1] == start[1]


def test_a_start_that_is_not_finite_is_returned() -> None:
    problem, start = decay("nan"), np.array([np.nan, 1.0, 1.0])
    assert minimize(problem, start, CLOSELY) is start
    assert problem.linearized == 0


def test_an_unsolvable_step_is_damped_until_the_limit() -> None:
    class Undetermined(Decay):
        def step(self, x: Array, equations: tuple[Array, Array], damping: float) -> Array | None:
            self.dampings.append(damping)
            return None

    problem = Undetermined(np.ones(3), np.ones(3), 1.0)
    assert minimize(problem, TRUTH, CLOSELY) is TRUTH
    np.testing.assert_allclose(problem.dampings, 10.0 ** np.arange(-4, 7))


def test_it_stops_at_the_least_decrease_and_at_the_last_step() -> None:
    problem, start = decay("stop"), TRUTH + 0.3
    for iterations in range(4):
        problem.dampings.clear()
        minimize(problem, start, MinimizeOptions(iterations, 1e-15))
        assert len(problem.dampings) == iterations
    problem.dampings.clear()
    minimize(problem, start, MinimizeOptions(200, 0.5))
    assert len(problem.dampings) < 10


def test_singular_systems_have_only_a_least_norm_step() -> None:
    singular, gradient = np.diag([2.0, 0.0]), np.array([2.0, 0.0])
    assert solve_step(singular, gradient) is None
    shortest = solve_step(singular, gradient, least_norm=True)
    assert shortest is not None
    np.testing.assert_allclose(shortest, [-1, 0])
    for broken in (np.full((2, 2), np.nan), np.diag([1.0, np.inf])):
        assert solve_step(broken, np.array([np.nan, 1.0]), least_norm=True) is None
        assert damped_step(broken, np.array([np.nan, 1.0]), 1.0) is None


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("squared", [1e-6, 0.3, 10.0, 1e6])
def test_losses_equal_scipys_and_weights_their_derivatives(scale: float, squared: float) -> None:
    s = np.array([squared])
    assert cauchy_cost(s, scale) == pytest.approx(scale**2 * math.log1p(squared / scale**2))
    theirs = least_squares(lambda x: [math.sqrt(squared) + 0 * x[0]], [0.0], loss="cauchy", f_scale=scale)
    assert cauchy_cost(s, scale) == pytest.approx(2 * theirs.cost)
    assert_jacobian(cauchy_weight(s, scale), lambda x: cauchy_cost(x, scale), s, tolerance=1e-5)
    theirs = least_squares(lambda x: [math.sqrt(squared) + 0 * x[0]], [0.0], loss="soft_l1", f_scale=scale)
    assert soft_l1(s, scale)[0] == pytest.approx(2 * theirs.cost)
    assert_jacobian(soft_l1_weight(s, scale), lambda x: float(soft_l1(x, scale)[0]), s, tolerance=1e-5)


@pytest.mark.parametrize(
    ("name", "value"), [("iterations", -1), ("min_decrease", 0.0), ("damping", -1.0), ("raised_by", 1.0)]
)
def test_a_wrong_option_is_named(name: str, value: float) -> None:
    known: dict[str, Any] = {"iterations": 1, "min_decrease": 0.1, name: value}
    with pytest.raises(ValueError, match=rf"{name} must be .* is {value}"):
        MinimizeOptions(**known)
