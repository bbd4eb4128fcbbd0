"""Errors of given poses: their covariance, and its sizes as the references' observations determine them."""

import numpy as np
import pytest
from support.planted import drift_field
from support.scenes import random_for

from mapless.geometry import Array, rotation_from_vector
from mapless_server.method.pose_errors import PoseErrorOptions, PoseErrors, most_probable, pose_errors

FOCAL_PX, DEPTH_M, LEVEL_PX = 500.0, 4.0, 0.5


def planted(case: str, count: int = 8) -> tuple[Array, Array, Array, PoseErrors]:
    """Centres (K, 3), rotations (K, 3, 3), the query's centre and the errors of references in a random arrangement."""
    random = random_for(case)
    centres, query = random.normal(0, 1, (count, 3)), random.normal(0, 0.3, 3)
    rotations = np.stack([rotation_from_vector(v) for v in random.normal(0, 1, (count, 3))])
    return centres, rotations, query, pose_errors(centres, rotations, query, LEVEL_PX, FOCAL_PX, DEPTH_M)


def test_the_drift_has_the_covariance_of_a_random_walk() -> None:
    """Of the errors in the world: a shift of the centre by -R^T v, a rotation by R^T w."""
    centres, rotations, query, errors = planted("walk", 4)
    spacing_m = float(np.median([np.linalg.norm(a - b) for i, a in enumerate(centres) for b in centres[:i]]))
    random, places = random_for("walks"), np.concatenate([query[None], centres])
    unit = LEVEL_PX / FOCAL_PX * np.repeat([DEPTH_M, 1.0], 3)
    walks = np.array([drift_field(places, spacing_m, random, 400)[1:] * unit for _ in range(4000)])
    motions = np.concatenate(
        [np.einsum("kab,nkb->nka", rotations, walks[:, :, part]) for part in (slice(3), slice(3, 6))], axis=2
    )
    found = np.cov(motions.reshape(len(walks), -1).T)
    scale = np.sqrt(np.outer(np.diag(errors.drift), np.diag(errors.drift)))
    np.testing.assert_allclose(found / scale, errors.drift / scale, atol=0.1)


def test_own_errors_are_independent_and_move_the_image_alike() -> None:
    _, _, _, errors = planted("own")
    angle = LEVEL_PX / FOCAL_PX
    np.testing.assert_allclose(errors.own, np.diag(np.tile(np.repeat([angle * DEPTH_M, angle], 3) ** 2, 8)), atol=1e-18)


def test_a_reference_at_the_place_of_the_query_does_not_drift() -> None:
    centres, rotations, _, _ = planted("at the query")
    errors = pose_errors(centres, rotations, centres[2], LEVEL_PX, FOCAL_PX, DEPTH_M)
    np.testing.assert_allclose(errors.drift[12:18], 0, atol=1e-15)


def test_references_at_one_place_have_a_finite_covariance() -> None:
    _, rotations, query, _ = planted("one place")
    errors = pose_errors(np.zeros((8, 3)), rotations, query, LEVEL_PX, FOCAL_PX, DEPTH_M)
    assert np.linalg.eigvalsh(errors.covariance(0.1, 1.0)).min() > 0


@pytest.mark.parametrize(("own", "drift"), [(0.05, 2.0), (0.8, 0.1), (0.4, 0.4)])
def test_planted_sizes_are_found(own: float, drift: float) -> None:
    """Within a factor of two, in the mean over gradients drawn from their distribution."""
    options = PoseErrorOptions(own_inflation=1.0, drift_inflation=1.0)
    found = []
    for seed in range(20):
        _, _, _, errors = planted(f"sizes {seed}", 10)
        random = random_for("sizes", seed)
        unit = np.append(np.sqrt(np.diag(errors.own)), np.sqrt(np.diag(errors.own))[:6])
        factor = random.normal(0, 10, (200, len(unit))) / unit
        matrix = factor.T @ factor
        error = random.multivariate_normal(np.zeros(60), errors.covariance(own, drift))
        gradient = factor.T @ random.normal(size=200) - matrix @ np.append(error, np.zeros(6))
        found.append(most_probable(errors, matrix, gradient, options))
    mean_own, mean_drift = np.exp(np.log(found).mean(axis=0))
    # The smaller part, below a third of the larger one, is only known to be small.
    assert own / 2 < mean_own < 2 * own or mean_own < drift / 3
    assert drift / 2 < mean_drift < 2 * drift or mean_drift < own / 3


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_without_evidence_the_usual_sizes_are_taken(value: float) -> None:
    _, _, _, errors = planted("no evidence", 3)
    options = PoseErrorOptions(usual_own=0.2, usual_drift=1.0, own_inflation=1.0, drift_inflation=3.0)
    own, drift = most_probable(errors, np.full((24, 24), value), np.full(24, value), options)
    assert own == pytest.approx(0.2)
    assert drift == pytest.approx(3.0)
