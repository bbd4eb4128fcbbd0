"""Poses from matches with the references themselves: planted truth without a single point that two references share.

Each reference observes points of its own, so nothing can be triangulated; the query observes the points of all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from support.scenes import CAMERA, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.dispersion import UncertaintyOptions
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.bundle.pose_problem import AdjustOptions
from mapless_server.method.bundle.priors import IntrinsicsSigma, PosePrior, Priors
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.views import Features, Matches, PosedView, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.judge.cameras import compare_cameras, wrong_camera
from mapless_server.method.judge.two_view import (
    TwoViewEvidence,
    lacks_distance,
    two_view_evidence,
    two_view_failure,
    two_view_trust,
)
from mapless_server.method.localize import localize
from mapless_server.method.optim.optimize import moved
from mapless_server.method.optim.rotations import rotation_vector
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.correspond import Correspondences, Matcher
from mapless_server.method.pairs.epipolar import sampson_px
from mapless_server.method.pairs.pair import Matching
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.pose.two_view import TwoViewOptions, solve_two_view
from mapless_server.method.pose.two_view_matches import TwoViewMatches
from mapless_server.method.rejection import Advice, IntrinsicsParameter, Rejection, RejectionReason
from mapless_server.method.structure.model import PointMatches
from mapless_server.method.structure.structure import StructureOptions

TRUE = RigidTransform(rotation_from_vector([0.1, -0.15, 0.05]), np.array([0.3, -0.1, -4.2]))
CENTRES = ((-1.2, 0.1, -4.0), (1.0, -0.2, -4.4), (0.2, 0.5, -3.6))
ORIGIN = np.zeros(3)


@dataclass(frozen=True, eq=False)
class Planted:
    """A query and its references, and the matches among them."""

    query: View
    references: tuple[PosedView, ...]
    correspondences: Correspondences

    def solved(self, intrinsics: IntrinsicsSigma | None = None) -> PosedSupport | None:
        matched = self.correspondences
        return solve_two_view(self.query, self.references, matched, ORIGIN, TwoViewOptions(), intrinsics)

    def evidence(self, support: PosedSupport) -> TwoViewEvidence:
        return two_view_evidence(support)


class Given(Matcher):
    """Matches as planted."""

    def __init__(self, correspondences: Correspondences) -> None:
        super().__init__()
        self._given = correspondences
        self.matched: list[Sequence[PosedView]] = []

    def correspond(
        self,
        query: View,
        references: Sequence[PosedView],
        matching: Matching = Matching.STRICT,
        check: Callable[[], None] = lambda: None,
        query_matches: Sequence[Matches] | None = None,
    ) -> Correspondences:
        self.matched.append(references)
        return self._given


def view_of(pixels: Array, random: np.random.Generator) -> View:
    """Keypoints with descriptors that have nothing in common."""
    descriptors = random.normal(size=(len(pixels), 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    sizes_px = np.full(len(pixels), 2.0, np.float32)
    return View(CAMERA, Features(pixels.astype(np.float32), descriptors.astype(np.float32), sizes_px))


def planted(
    counts: Sequence[int] = (60, 60, 60),
    noise_px: float = 0.0,
    wrong_share: float = 0.0,
    seed: int = 0,
    pose_noise_px: float = 0.0,
) -> Planted:
    """References that observe so many points each, all of which the query observes too; keypoint i of point i.

    The stored poses of the references are turned by so many pixels, and shifted by as much at four metres.
    """
    random = random_for("two views", counts, noise_px, wrong_share, seed)
    references: list[PosedView] = []
    seen: list[Array] = []
    matches: list[Matches] = []
    for index, (count, centre) in enumerate(zip(counts, CENTRES, strict=False)):
        pose = RigidTransform(rotation_from_vector(random.normal(0, 0.05, 3)), np.array(centre))
        points = random.uniform([-1.6, -1.1, -1.0], [1.6, 1.1, 1.5], (count, 3))
        own, queried = (CAMERA.project(it.inverse().apply(points)) for it in (pose, TRUE))
        wrong = np.arange(count) < wrong_share * count
        queried = np.where(wrong[:, None], random.uniform([0, 0], [959, 719], (count, 2)), queried)
        own, queried = (it + random.normal(0, noise_px, it.shape) for it in (own, queried))
        angle = pose_noise_px / CAMERA.focal_x_px
        stored = moved(pose, random.normal(0, np.repeat([4 * angle, angle], 3))) if pose_noise_px else pose
        references.append(PosedView(f"{index}", f"reference {index}", view_of(own, random), stored))
        first = len(np.concatenate(seen)) if seen else 0
        matches.append(np.stack([first + np.arange(count), np.arange(count)], axis=1).astype(np.int32))
        seen.append(queried)
    nothing = np.empty((0, 2), np.int32)
    pairs = {(i, j): nothing for i in range(len(counts)) for j in range(i + 1, len(counts))}
    query = view_of(np.concatenate(seen), random)
    return Planted(query, tuple(references), Correspondences(pairs, tuple(matches)))


def error_of(pose: RigidTransform) -> Array:
    """The error (6,): x y z rx ry rz."""
    return np.concatenate([pose.translation - TRUE.translation, rotation_vector(pose.rotation @ TRUE.rotation.T)])


def pose_of(support: PosedSupport | None) -> RigidTransform:
    assert support is not None
    assert support.estimate is not None
    return support.estimate.world_from_camera


@pytest.mark.parametrize("counts", [(40, 40), (60, 12), (60, 60, 60)])
def test_exact_matches_give_the_true_pose_without_any_point(counts: tuple[int, ...]) -> None:
    support = planted(counts).solved()
    assert support is not None
    assert not len(support.matches)
    np.testing.assert_allclose(error_of(pose_of(support)), 0, atol=1e-4)  # keypoints are float32


@pytest.mark.parametrize("wrong_share", [0.3, 0.6])
def test_wrong_matches_among_right_ones_are_no_inliers(wrong_share: float) -> None:
    for seed in range(3):
        problem = planted((80, 60, 50), 0.5, wrong_share, seed)
        support = problem.solved()
        assert np.linalg.norm(error_of(pose_of(support))[:3]) < 0.05
        assert support is not None
        assert two_view_failure(problem.evidence(support)) is None


@pytest.mark.parametrize("pose_noise_px", [0.0, 1.0])
def test_covariance_is_right_against_planted_noise(pose_noise_px: float) -> None:
    """The mean squared errors of 16 poses, over the mean of what is stated."""
    errors, stated = [], []
    plain = AdjustOptions(uncertainty=UncertaintyOptions(position_factor=1.0, rotation_factor=1.0, gap_growth=0.0))
    for seed in range(16):
        problem = planted((60, 60, 60), 0.5, 0.0, seed, pose_noise_px)
        matched, stages = problem.correspondences, TwoViewOptions(adjust=plain)
        support = solve_two_view(problem.query, problem.references, matched, ORIGIN, stages)
        assert support is not None
        assert support.estimate is not None
        errors.append(error_of(support.estimate.world_from_camera))
        stated.append(np.diag(support.estimate.covariance))
    for axes in (slice(0, 3), slice(3, 6)):
        ratio = np.sqrt(np.mean(np.square(errors), axis=0)[axes].sum() / np.mean(stated, axis=0)[axes].sum())
        assert 0.4 < ratio < 1.2, ratio


def test_one_reference_tells_the_direction_but_no_distance() -> None:
    problem = planted((120, 2), 0.3)
    answer = localize(
        problem.query,
        problem.references,
        Pipeline(make_reconstructor("geometric", Path()), Given(problem.correspondences)),
        LocalizeOptions(),
    )
    assert isinstance(answer.outcome, Rejection)
    assert "determines the direction but not the distance" in answer.outcome.message
    hint = answer.outcome.hint
    assert hint is not None
    assert (hint.advice, hint.best_reference) == (Advice.ADD_REFERENCES, "reference 0")


def test_localize_answers_where_nothing_can_be_triangulated() -> None:
    problem = planted((70, 60, 50), 0.5, 0.3)
    pipeline = Pipeline(make_reconstructor("geometric", Path()), Given(problem.correspondences))
    answer = localize(problem.query, problem.references, pipeline, LocalizeOptions())
    assert isinstance(answer.outcome, Localization), answer.outcome
    assert np.linalg.norm(error_of(answer.outcome.world_from_camera)[:3]) < 0.05
    assert "two_view" in answer.stage_seconds
    assert 100 < answer.outcome.inlier_count < answer.outcome.match_count == 180
    assert sum(answer.reference_inlier_counts) == answer.outcome.inlier_count
    failed = localize(problem.query, problem.references[:1], pipeline, LocalizeOptions()).outcome
    assert isinstance(failed, Rejection)
    assert failed.reason is RejectionReason.NO_USABLE_REFERENCES


def with_doubtful_points(problem: Planted, right: int, wrong: int) -> Planted:
    """Adds points that references 0 and 1 share; the query's matches with them are right, and then wrong."""
    count, random = right + wrong, random_for("doubtful points", right, wrong)
    points = random.uniform([-1.6, -1.1, -1.0], [1.6, 1.1, 1.5], (count, 3))
    queried = CAMERA.project(TRUE.inverse().apply(points))
    queried[right:] = random.uniform([0, 0], [959, 719], (wrong, 2))

    def with_pixels(view: View, pixels: Array) -> View:
        both = np.concatenate([view.features.keypoints, pixels])
        return view_of(both, random)

    references, matches = list(problem.references), list(problem.correspondences.query_matches)
    added = np.arange(count)
    firsts = [len(references[i].view.features) for i in (0, 1)]
    for i in (0, 1):
        seen = CAMERA.project(references[i].world_from_camera.inverse().apply(points))
        references[i] = replace(references[i], view=with_pixels(references[i].view, seen))
        more = np.stack([len(problem.query.features) + added, firsts[i] + added], axis=1).astype(np.int32)
        matches[i] = np.concatenate([matches[i], more])
    shared = np.stack([firsts[0] + added, firsts[1] + added], axis=1).astype(np.int32)
    pairs = dict(problem.correspondences.reference_pairs) | {(0, 1): shared}
    query = with_pixels(problem.query, queried)
    return Planted(query, tuple(references), Correspondences(pairs, tuple(matches)))


@pytest.mark.parametrize("sigmas", [(0.05, 1), (0.5, 10), (5, 60)])
def test_a_right_prior_costs_no_answer_of_two_views(sigmas: tuple[float, float]) -> None:
    """Points that are too few for a pose of the photograph alone are matched again at the prior's pose."""
    problem = with_doubtful_points(planted((70, 60, 50), 0.5, 0.3), 5, 30)
    pipeline = Pipeline(make_reconstructor("geometric", Path()), Given(problem.correspondences))
    free = localize(problem.query, problem.references, pipeline, LocalizeOptions()).outcome
    assert isinstance(free, Localization), free
    deviations = np.repeat([sigmas[0], np.radians(sigmas[1])], 3)
    priors = Priors(pose=PosePrior(TRUE, np.diag(np.square(deviations))))
    found = localize(problem.query, problem.references, pipeline, LocalizeOptions(), priors=priors).outcome
    assert isinstance(found, Localization), found
    assert np.linalg.norm(error_of(found.world_from_camera)[:3]) < 0.05
    assert found.trust == free.trust
    assert [check.conflict for check in found.prior_checks] == [False]


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_intrinsics_of_another_image_size_are_named(factor: float) -> None:
    problem = planted((70, 60, 50), 0.5, 0.3)
    camera = replace(
        CAMERA,
        focal_x_px=factor * CAMERA.focal_x_px,
        focal_y_px=factor * CAMERA.focal_y_px,
        principal_x_px=factor * CAMERA.principal_x_px,
        principal_y_px=factor * CAMERA.principal_y_px,
    )
    problem = replace(problem, query=replace(problem.query, camera=camera))
    support = problem.solved()
    assert support is not None
    rejection = wrong_camera(support, "a")
    if factor == 1:
        assert rejection is None
        return
    assert rejection is not None
    assert rejection.message.startswith("its matches agree better with a pose of focal_x_px")
    found = {it.parameter: it.estimated for it in rejection.intrinsics_checks}
    assert found[IntrinsicsParameter.FOCAL_LENGTH] == pytest.approx(CAMERA.focal_x_px, rel=0.01)
    assert found[IntrinsicsParameter.PRINCIPAL_X] == pytest.approx((CAMERA.width_px - 1) / 2)
    less_certain = problem.solved(IntrinsicsSigma(focal_share=0.2))
    assert less_certain is not None
    tried = wrong_camera(less_certain, "a")
    assert tried is not None
    assert tried.intrinsics_checks[0].given_sigma == pytest.approx(0.2 * camera.focal_x_px)


def test_cameras_that_the_caller_allows_are_not_compared() -> None:
    problem = planted((70, 60, 50), 0.5, 0.3)
    camera = replace(CAMERA, focal_x_px=2 * CAMERA.focal_x_px, focal_y_px=2 * CAMERA.focal_y_px)
    problem = replace(problem, query=replace(problem.query, camera=camera))
    given, uncertain = problem.solved(), problem.solved(IntrinsicsSigma(focal_share=0.5))
    assert given is not None
    assert uncertain is not None
    for support in (given, without_evidence(given)):
        assert wrong_camera(support, "a") is not None
    for support in (uncertain, without_evidence(uncertain)):
        assert wrong_camera(support, "a") is None


@pytest.mark.parametrize("fitting", [40, 120])
def test_a_camera_that_a_search_by_points_missed_is_not_accused(fitting: int) -> None:
    """So many of 180 points fit a longer focal length, with which alone a pose is found; all lines fit the given one.

    The camera is accused only where the points outweigh the lines.
    """
    random, problem = random_for("missed", fitting), planted((70, 60, 50))
    longer = replace(CAMERA, focal_x_px=2**0.25 * CAMERA.focal_x_px, focal_y_px=2**0.25 * CAMERA.focal_y_px)
    rays = longer.rays(problem.query.features.pixels())
    depth_m = random.uniform(1, 9, (len(rays), 1))
    x_in_world = np.where(
        np.arange(len(rays))[:, None] < fitting, TRUE.apply(depth_m * rays), 10 * random.normal(size=rays.shape)
    )
    solved = problem.solved()
    assert solved is not None
    every = np.arange(len(rays))
    structure = replace(solved.structure, x_in_world=x_in_world)
    matches = PointMatches(every, every, np.zeros(len(rays), bool), 4.0)
    missed = replace(
        solved.estimate, world_from_camera=moved(TRUE, np.full(6, 0.5)), inliers=every < 8, intrinsics=None, view=None
    )
    support = replace(solved, structure=structure, matches=matches, estimate=missed, two_view=None)
    compared = compare_cameras(support)
    assert compared is not None
    assert compared.gain > 1.1
    assert compared.is_significant == (fitting == 120)


def without_evidence(support: PosedSupport) -> PosedSupport:
    """The support with singular equations of the intrinsics' errors."""
    assert support.estimate is not None
    return replace(support, estimate=replace(support.estimate, intrinsics=None))


def test_uncertain_intrinsics_are_in_a_two_view_covariance() -> None:
    """The caller's standard deviations, not the default ones: the pose moves along with errors of the intrinsics."""
    problem = planted((70, 60, 50), 0.5)
    usual, certain, uncertain = (
        problem.solved(it)
        for it in (IntrinsicsSigma(), IntrinsicsSigma(1e-6, 1e-6, 1e-6), IntrinsicsSigma(0.01, 0.01, 0.03))
    )
    sigmas_m = []
    for support in (certain, usual, uncertain):
        assert support is not None
        assert support.estimate is not None
        sigmas_m.append(np.sqrt(np.trace(support.estimate.covariance[:3, :3])))
    assert sigmas_m[0] < sigmas_m[1] / 2
    assert sigmas_m[1] < sigmas_m[2] / 1.5


def test_references_are_always_matched_at_their_given_poses() -> None:
    """Whatever the origin of the query's world is, since matches and points are cached."""
    problem = planted((70, 60, 50), 0.5, 0.3)
    matcher = Given(problem.correspondences)
    pipeline = Pipeline(make_reconstructor("geometric", Path()), matcher)
    far = [replace(it, world_from_camera=it.world_from_camera.shifted(np.full(3, 0.1))) for it in problem.references]
    assert "two_view" in localize(problem.query, far, pipeline, LocalizeOptions()).stage_seconds
    assert len(matcher.matched) > 1
    for references in matcher.matched:
        assert [it.world_from_camera for it in references] == [it.world_from_camera for it in far]


def test_random_matches_have_no_accepted_pose() -> None:
    for seed in range(2):
        problem = planted((150, 120, 100), 0.0, 1.0, seed)
        support = problem.solved()
        assert support is None or two_view_failure(problem.evidence(support)) is not None


def test_a_second_reference_of_another_place_is_no_support() -> None:
    """One relative pose is right, the matches with the other references are random."""
    right, random = planted((150, 100), 0.3), planted((150, 100), 0.0, 1.0)
    counts = [len(it) for it in right.correspondences.query_matches]
    features = right.query.features
    mixed = np.concatenate([features.keypoints[: counts[0]], random.query.features.keypoints[counts[0] :]])
    problem = replace(right, query=replace(right.query, features=replace(features, keypoints=mixed)))
    support = problem.solved()
    assert support is not None
    assert lacks_distance(problem.evidence(support))


def test_sampson_distances_are_those_of_the_fundamental_matrix() -> None:
    problem = planted((30, 20), 1.0, 0.5)
    two_view = TwoViewMatches.of(problem.query, problem.references, problem.correspondences.query_matches)
    pose = moved(TRUE, np.array([0.1, -0.2, 0.3, 0.02, 0.01, -0.03]))
    expected = [
        sampson_px(PosedView("", "", problem.query, pose), reference, matches)
        for reference, matches in zip(problem.references, problem.correspondences.query_matches, strict=True)
    ]
    np.testing.assert_allclose(two_view.sampson_px(pose), np.concatenate(expected), rtol=1e-6)


def test_sampson_distances_along_a_line_are_those_at_its_points() -> None:
    problem = planted((30, 20), 1.0)
    two_view = TwoViewMatches.of(problem.query, problem.references, problem.correspondences.query_matches)
    direction, distances = np.array([0.3, 0.1, -0.2]), np.array([-1.0, 0.0, 2.5])
    along = two_view.sampson_along_px(TRUE.rotation, TRUE.translation, direction, distances)
    for distance, row in zip(distances, along, strict=True):
        np.testing.assert_allclose(row, two_view.sampson_px(TRUE.shifted(distance * direction)), rtol=1e-6)


def test_triangulated_points_are_the_planted_ones() -> None:
    problem = planted((40, 30))
    two_view = TwoViewMatches.of(problem.query, problem.references, problem.correspondences.query_matches)
    points, parallax_deg = two_view.triangulated(
        problem.query, problem.references, TRUE, StructureOptions().first_noise
    )
    projected = CAMERA.project(TRUE.inverse().apply(points))
    np.testing.assert_allclose(projected, problem.query.features.keypoints, atol=1e-3)
    assert (parallax_deg > 1).all()


def test_trust_rises_with_the_second_references_share() -> None:
    shares = np.linspace(0, 1, 21)
    trusts = [two_view_trust(TwoViewEvidence(-50, -20, 100, 200, 40, it, 0.5)) for it in shares]
    assert trusts == sorted(trusts)
    assert (trusts[0], trusts[-1]) == (0, 1)


@pytest.mark.parametrize(
    ("evidence", "part"),
    [
        (TwoViewEvidence(-10.0, -20.0, 100, 200, 40, 0.5, 0.5), "chance could do"),
        (TwoViewEvidence(-50.0, -1.0, 100, 200, 40, 0.5, 0.5), "one reference"),
        (TwoViewEvidence(-50.0, -20.0, 100, 200, 40, 0.1, 0.5), "repeated structure"),
        (TwoViewEvidence(-50.0, -20.0, 100, 200, 40, 0.5, 0.01), "of the image"),
    ],
)
def test_each_lack_of_evidence_is_named(evidence: TwoViewEvidence, part: str) -> None:
    assert part in (two_view_failure(evidence) or "")
    assert two_view_failure(TwoViewEvidence(-50.0, -20.0, 100, 200, 40, 0.5, 0.5)) is None
