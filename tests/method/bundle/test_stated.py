"""Errors that adopted references state of their poses, in the answers that rest on them: planted errors, and bounds."""

from dataclasses import replace

import numpy as np
import pytest
from support.planted import stages
from support.scenes import SceneOptions, make_scene, random_for

from mapless.answers import Accuracy
from mapless.geometry import Array, RigidTransform
from mapless.provenance import ADOPTED, Provenance, Voucher
from mapless_server.method.bundle.adjust import adjust_pose
from mapless_server.method.bundle.estimate import PoseEstimate, accuracy_from_covariance, with_information
from mapless_server.method.bundle.pose_problem import AdjustInput, AdjustOptions, pose_errors
from mapless_server.method.bundle.priors import PositionPrior, Priors
from mapless_server.method.features.views import PosedView
from mapless_server.method.optim.optimize import covariance_in_world, moved
from mapless_server.method.optim.rotations import rotation_vector

OPTIONS = SceneOptions(point_count=150, reference_count=6)


def adopted(covariance: Array) -> Provenance:
    """How an adopted pose with this covariance (6, 6) is known."""
    radii = Accuracy(**vars(accuracy_from_covariance(covariance)))
    return Provenance(ADOPTED, radii, 1.0, (Voucher("surveyed", 30),), covariance.tolist())


def covariance_of(case: str, position_m: float, rotation_rad: float) -> Array:
    """A random covariance with about these standard deviations, which correlates positions and rotations."""
    root = random_for(case).normal(0, 1, (6, 6)) / np.sqrt(6)
    scale = np.repeat([position_m, rotation_rad], 3)
    return np.asarray(scale[:, None] * (root @ root.T + 0.1 * np.eye(6)) * scale)


def answer(
    case: str, count: int, covariance: Array, error: Array, sigma_m: Array | None = None
) -> tuple[PoseEstimate, RigidTransform]:
    """The adjusted pose where the first references are adopted and off by an error (6,) in the world; the truth.

    With standard deviations (3,) there is a prior at the true position.
    """
    scene = make_scene(random_for(case), OPTIONS)

    def view(i: int, it: PosedView) -> PosedView:
        if i >= count:
            return it
        return replace(it, world_from_camera=moved(it.world_from_camera, error), provenance=adopted(covariance))

    references = tuple(view(i, it) for i, it in enumerate(scene.references))
    structure, matches, estimate = stages(scene, references)
    given = AdjustInput(scene.query, references, structure, matches, AdjustOptions())
    truth = scene.world_from_query
    known = None if sigma_m is None else PositionPrior(truth.translation, np.diag(sigma_m**2))
    return adjust_pose(given, estimate, Priors(known)), truth


def test_a_stated_covariance_is_of_its_reference_in_the_world() -> None:
    covariance = covariance_of("stated", 0.03, 0.004)
    pose = make_scene(random_for("stated"), OPTIONS).references[0].world_from_camera
    given = np.zeros((1, 3)), pose.rotation.T[None], np.ones(3), 1.0, 1000.0, 3.0, None
    added = pose_errors(*given, [adopted(covariance)]).covariance(0.1, 1) - pose_errors(*given).covariance(0.1, 1)
    np.testing.assert_allclose(covariance_in_world(added, pose), covariance, rtol=1e-9, atol=1e-12)


def test_radii_contain_what_all_references_are_off_in_common() -> None:
    covariance = covariance_of("all", 0.03, 0.004)
    found = answer("all adopted", OPTIONS.reference_count, covariance, np.zeros(6))[0].covariance
    radii, stated = accuracy_from_covariance(found), accuracy_from_covariance(covariance)
    assert 0.95 < radii.position_68_m / stated.position_68_m < 1.1
    assert 0.95 < radii.rotation_68_deg / stated.rotation_68_deg < 1.1


def test_surveyed_references_beside_adopted_ones_hold_the_pose() -> None:
    covariance = covariance_of("some", 0.2, 0.02)
    sizes = [np.trace(answer("some", n, covariance, np.zeros(6))[0].covariance[:3, :3]) ** 0.5 for n in (0, 2, 4, 6)]
    assert sizes[0] < sizes[1] < sizes[2] < sizes[3]
    assert sizes[1] < 0.2 * sizes[3]


@pytest.mark.parametrize("count", [3, 6])
def test_errors_are_as_large_as_planted_common_ones_say(count: int) -> None:
    """In the mean over scenes, whose adopted references are all off by one error drawn from what they state."""
    covariance, ratios = covariance_of("drawn", 0.03, 0.004), []
    for seed in range(15):
        error = random_for("drawn", seed).multivariate_normal(np.zeros(6), covariance)
        found, truth = answer(f"drawn {seed}", count, covariance, error)
        pose = found.world_from_camera
        turn = rotation_vector(pose.rotation @ truth.rotation.T)
        off = np.concatenate([pose.translation - truth.translation, turn])
        ratios.append(off @ np.linalg.solve(found.covariance, off) / 6)
    assert 0.2 < np.mean(ratios) < 1.3


def test_a_prior_along_one_axis_leaves_what_is_off_along_others() -> None:
    covariance = np.diag([0.03] * 3 + [0.004] * 3) ** 2
    given = "prior", OPTIONS.reference_count, covariance, np.zeros(6)
    alone, informed = (answer(*given, sigma_m)[0] for sigma_m in (None, np.array([10.0, 10.0, 1e-4])))
    before, after = alone.reference_covariance, informed.reference_covariance
    assert before is not None
    assert after is not None
    assert after[2, 2] < 1e-3 * before[2, 2]
    np.testing.assert_allclose(np.diag(after)[:2], np.diag(before)[:2], rtol=0.2)
    assert np.linalg.eigvalsh(informed.covariance - after).min() > -1e-15


def test_a_sharper_covariance_contains_its_part_by_references() -> None:
    estimate, _ = answer("contained", OPTIONS.reference_count, covariance_of("contained", 0.03, 0.004), np.zeros(6))
    for seed in range(200):
        random = random_for("contained", seed)
        part, rest, root = (random.normal(size=(6, count)) for count in (3, 6, 1 + seed % 6))
        planted = replace(estimate, covariance=part @ part.T + rest @ rest.T, reference_covariance=part @ part.T)
        found = with_information(planted, 10.0 ** random.uniform(-3, 4) * root @ root.T)
        assert found.reference_covariance is not None
        assert np.linalg.eigvalsh(found.covariance - found.reference_covariance).min() > -1e-9
