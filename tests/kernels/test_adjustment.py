"""The adjustment by compiled code: against the plain version, to rounding; sizes and indices that do not fit."""

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
from support.planted import NOISE, true_structure
from support.scenes import SceneOptions, make_scene, random_for

from mapless.geometry import Array
from mapless_server.kernels import adjustment
from mapless_server.kernels.adjustment import Seen
from mapless_server.method.bundle.bundle import BundleProblem
from mapless_server.method.bundle.dispersion import disperse
from mapless_server.method.bundle.normal_equations import Bundle, Linearized
from mapless_server.method.bundle.pose_problem import AdjustInput, AdjustOptions, pose_problem, with_intrinsics
from mapless_server.method.structure.observations import adjust_points
from mapless_server.method.structure.structure import observe

pytestmark = pytest.mark.skipif(not adjustment.IS_COMPILED, reason="not compiled")

SAME = 1e-9
"""Largest difference by rounding, as a share of the largest number of an array; inverses lose five digits."""

T = TypeVar("T")


UNKNOWNS = (0, 4, 10)
"""Unknowns of the query beside its pose: none, errors of its intrinsics, and its motion during the read-out besides."""


def planted(case: str, unknowns: int) -> tuple[BundleProblem, Bundle]:
    """A problem of five references off its optimum, of which every third point is missing in the first."""
    scene = make_scene(random_for(case), SceneOptions(point_count=120, reference_count=5))
    structure, matches = true_structure(scene, NOISE)
    tracks = structure.tracks
    kept = (tracks.view != 0) | (tracks.point % 3 != 0)
    structure = replace(structure, tracks=tracks.prune(kept)[0])
    given = AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions())
    problem, start = pose_problem(given, np.arange(len(matches)), scene.world_from_query)
    motion = random_for(case, "moved").normal(0, 1e-3, (6, 6))
    bundle = start.bundle.moved(motion, np.zeros_like(start.bundle.points))
    if not unknowns:
        return problem, bundle
    wider, bundle = with_intrinsics(problem, bundle, scene.query)
    bundle = replace(bundle, intrinsics=np.array([1e-3, 0.5, -0.5, 2e-3]))
    return (wider, bundle) if unknowns == 4 else with_motion(case, wider, bundle)


def with_motion(case: str, problem: BundleProblem, bundle: Bundle) -> tuple[BundleProblem, Bundle]:
    """The problem with six more unknowns, each observation of the query at a time of its own."""
    seen, more = problem.by_view, np.full(6, 1e-3)
    by_pose = seen.at(bundle).by_pose[:, :, seen.parts[-1]]
    by_motion = by_pose * random_for(case, "times").uniform(-0.5, 0.5, by_pose.shape[2])
    columns = replace(seen, by_intrinsics=np.concatenate([seen.by_intrinsics, by_motion], axis=1))
    information, offset = problem.intrinsics_information, problem.intrinsics_offset
    assert information is not None
    assert offset is not None
    wider = replace(
        problem,
        by_view=columns,
        intrinsics_information=np.concatenate([information, more]),
        intrinsics_offset=np.concatenate([offset, more]),
    )
    return wider, replace(bundle, intrinsics=np.concatenate([bundle.intrinsics, more]))


def by_both(monkeypatch: pytest.MonkeyPatch, compute: Callable[[], T]) -> tuple[T, T]:
    """The results by compiled and by plain code."""
    compiled = compute()
    with monkeypatch.context() as patch:
        patch.setattr(adjustment, "IS_COMPILED", False)
        return compiled, compute()


def assert_same(first: Array, second: Array, share: float = SAME) -> None:
    assert first.shape == second.shape
    np.testing.assert_allclose(first, second, rtol=0, atol=share * np.abs(second).max(initial=0.0))


@pytest.mark.parametrize("unknowns", UNKNOWNS)
def test_residuals_and_derivatives(monkeypatch: pytest.MonkeyPatch, unknowns: int) -> None:
    problem, bundle = planted("project", unknowns)
    first, second = by_both(monkeypatch, lambda: problem.at(bundle))
    for name in ("residual", "by_point", "by_pose"):
        assert_same(getattr(first, name), getattr(second, name))


def test_residuals_behind_a_camera_are_not_a_number() -> None:
    problem, bundle = planted("behind", 0)
    bundle.points[3] = bundle.poses.centres[-1] - bundle.poses.rotation[-1][2]
    is_nan = np.asarray(np.isnan(problem.at(bundle).residual).all(axis=0))
    assert is_nan[(problem.by_view.point == 3) & (problem.by_view.view == 5)].all()
    assert not is_nan[problem.by_view.point != 3].any()


@pytest.mark.parametrize("unknowns", UNKNOWNS)
@pytest.mark.parametrize("least_curvature", [0.5, 1.0])
def test_a_step_of_the_bundle(monkeypatch: pytest.MonkeyPatch, unknowns: int, least_curvature: float) -> None:
    problem, bundle = planted("step", unknowns)
    curved = replace(problem, least_curvature=least_curvature)

    def step() -> tuple[Array, Array, Linearized | None]:
        there = curved.at(bundle)
        equations = curved.linearize(there)
        matrix, gradient, _ = equations.reduced(1e-4)
        return matrix, gradient, curved.step(there, equations, 1e-4)

    first, second = by_both(monkeypatch, step)
    assert_same(first[0], second[0])
    assert_same(first[1], second[1])
    assert first[2] is not None
    assert second[2] is not None
    assert_same(first[2].bundle.points, second[2].bundle.points)
    assert_same(first[2].bundle.poses.rotation, second[2].bundle.poses.rotation)
    assert_same(first[2].bundle.intrinsics, second[2].bundle.intrinsics)


@pytest.mark.parametrize("unknowns", UNKNOWNS[1:])
def test_changes_without_parts_of_the_data(monkeypatch: pytest.MonkeyPatch, unknowns: int) -> None:
    problem, bundle = planted("dispersion", unknowns)
    first, second = by_both(monkeypatch, lambda: disperse(problem, bundle, 60))
    assert first
    assert second
    for name in ("references", "regions", "offset"):
        assert_same(getattr(first, name), getattr(second, name), 1e-5)
    assert_same(first.intrinsics.matrices, second.intrinsics.matrices, 1e-5)


def test_points_adjusted_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_scene(random_for("alone"), SceneOptions(point_count=80, reference_count=4))
    structure, _ = true_structure(scene, NOISE)
    observations = observe(structure.tracks, scene.references, structure.noise)
    start = structure.x_in_world + random_for("alone", "start").normal(0, 0.05, structure.x_in_world.shape)
    start[0] = np.nan
    first, second = by_both(monkeypatch, lambda: adjust_points(observations, start, 2.0, 4))
    assert np.isnan(first[0]).all()
    assert np.isfinite(first[1:]).all()
    assert_same(first[1:], second[1:])


@pytest.mark.parametrize(
    ("end", "point", "view", "points"),
    [
        ([1, 2], [0, 1], [0, 1], 1),
        ([1, 2], [0, -1], [0, 1], 2),
        ([1, 3], [0, 1], [0, 1], 2),
        ([2, 1], [0, 1], [0, 1], 2),
        ([1, 2], [0, 1], [1, 1], 2),
        ([1, 2], [0, 1], [0], 2),
    ],
)
def test_what_does_not_fit_is_an_error(end: list[int], point: list[int], view: list[int], points: int) -> None:
    seen = Seen(np.array(end), np.array(point), np.array(view), points, 0)
    poses = np.zeros((2, 3, 3)), np.zeros((2, 3))
    with pytest.raises(ValueError, match="do not fit"):
        adjustment.project(seen, *poses, np.zeros((points, 3)), np.ones((2, len(point))), np.zeros((2, len(point))))


def test_arrays_of_another_size_are_errors() -> None:
    seen = Seen(np.array([1, 2]), np.array([0, 0]), np.array([0, 1]), 1, 0)
    poses = np.zeros((2, 3, 3)), np.zeros((1, 3))
    with pytest.raises(ValueError, match="do not fit"):
        adjustment.project(seen, *poses, np.zeros((1, 3)), np.ones((2, 2)), np.zeros((2, 2)))
