"""The optimizer and its losses: minima against SciPy's, damping, stopping, wrong options."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from scipy import optimize
from support.scenes import random_for

from mapless.geometry import Array
from mapless_server.method.optim.optimize import (
    MinimizeOptions,
    cauchy_cost,
    cauchy_weight,
    damped_step,
    minimize,
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
