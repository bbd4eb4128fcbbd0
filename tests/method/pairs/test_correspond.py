"""Matching of descriptors: against brute force, against known epipolar geometry; the cache of pairs."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.planted import AnyRatio, same_points
from support.scenes import CAMERA, SceneOptions, make_scene, random_for, unit_rows

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.kernels import nearest
from mapless_server.method.features import matching
from mapless_server.method.features.extractors import FEATURES
from mapless_server.method.features.matching import (
    OPTIONS,
    CorrespondOptions,
    SharedThreads,
    StoredPair,
    mutual_matches,
    row_maxima,
)
from mapless_server.method.features.views import Features, Matches, PosedView, View
from mapless_server.method.pairs import pair as reference_pairs
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.epipolar import epipolar_distance_px, epipolar_distances_px
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.pairs.pair import Matching, in_order
from mapless_server.scheduling.processor import lower_priority

TWO = (Matching.STRICT, Matching.WIDE)


def features(descriptors: Array, keypoints: Array | None = None) -> Features:
    n = len(descriptors)
    return Features(
        (np.zeros((n, 2)) if keypoints is None else keypoints).astype(np.float32),
        descriptors.astype(np.float32),
        np.ones(n, np.float32),
    )


def whole(descriptors: NDArray[np.int64]) -> Features:
    return replace(features(np.zeros((len(descriptors), 1))), descriptors=descriptors.astype(np.int8))


def related(random: np.random.Generator, n: int, m: int, noise: float, size: int = 16) -> tuple[Features, Features]:
    """Descriptors of which some show the same."""
    common = unit_rows(random.standard_normal((max(n, m), size)))
    first = unit_rows(common[random.permutation(len(common))[:n]] + noise * random.standard_normal((n, size)))
    second = unit_rows(common[:m] + noise * random.standard_normal((m, size)))
    return features(first), features(second)


def slow_mutual_matches(first: Features, second: Features, ratio: float, either: bool) -> list[list[int]]:
    """The same by loops over distances."""
    distance = [[float(np.linalg.norm(a - b)) for b in second.descriptors] for a in first.descriptors]
    matches = []
    for i, row in enumerate(distance):
        j = min(range(len(row)), key=row.__getitem__)
        back = min(range(len(distance)), key=lambda other: distance[other][j])
        second_best = min(d for k, d in enumerate(row) if k != j)
        if either:
            second_best = max(second_best, min(other[j] for k, other in enumerate(distance) if k != i))
        if back == i and row[j] < ratio * second_best:
            matches.append([i, j])
    return matches


@pytest.mark.parametrize("either", [False, True])
@pytest.mark.parametrize("ratio", [0.7, 0.85, 1.0])
@pytest.mark.parametrize(("n", "m", "noise"), [(2, 2, 0.1), (40, 25, 0.1), (25, 40, 0.2), (30, 30, 0.5)])
def test_mutual_matches_equal_brute_force(n: int, m: int, noise: float, ratio: float, either: bool) -> None:
    first, second = related(random_for("mutual", n, m, noise), n, m, noise)
    matches = mutual_matches(first, second, ratio, either)
    assert matches.dtype == np.int32
    assert matches.tolist() == slow_mutual_matches(first, second, ratio, either)
    if either:
        turned = mutual_matches(second, first, ratio, either)
        assert sorted(turned[:, ::-1].tolist()) == matches.tolist()


@pytest.mark.parametrize(("n", "m"), [(2, 3), (9, 17), (130, 500), (300, 128)])
def test_compiled_and_plain_matches_are_the_same(n: int, m: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ties included: of descriptors of few different numbers, many are equal."""
    if not nearest.is_available(64):
        pytest.skip("not compiled, or the processor has no AVX512-VNNI")
    random = random_for("compiled", n, m)
    for most in (1, 127):
        first, second = (whole(random.integers(-most, most + 1, (k, 64))) for k in (n, m))
        for either in (False, True):
            compiled = mutual_matches(first, second, 0.99, either)
            with monkeypatch.context() as plain:
                plain.setattr(nearest, "is_available", lambda length: False)
                assert mutual_matches(first, second, 0.99, either).tolist() == compiled.tolist()


@pytest.mark.parametrize(
    ("n", "m", "step"), [(0, 5, 6), (1, 5, 6), (5, 0, 2), (7, 1, 6), (2, 9, 6), (25, 40, 6), (9, 9, 1)]
)
def test_matches_of_a_sample_and_the_rest_are_those_of_all(n: int, m: int, step: int) -> None:
    random = random_for("sample", n, m)
    first, second = (whole(random.integers(-1, 2, (k, 64))) for k in (n, m))
    for ours, theirs in (first, second), related(random, n, m, 0.1) if min(n, m) else (first, second):
        sampled, rest = (row_maxima(some, theirs) for some in (ours.every(step), ours.but_every(step)))
        expected = mutual_matches(ours, theirs, 0.99).tolist()
        assert rest.with_every(step, sampled).matches(0.99).tolist() == expected


def test_ambiguous_descriptors_are_not_matched() -> None:
    twice = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    for either in (False, True):
        assert mutual_matches(features(twice), features(twice), 0.9, either).tolist() == [[2, 2]]
    # Seen from the other photograph, there is one keypoint and none like it.
    once = features(np.array([[1.0, 0.0], [0.0, 1.0]]))
    assert mutual_matches(features(twice), once, 0.9, either=True).tolist() == [[2, 1]]


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0), (1, 5), (5, 1)])
def test_photographs_with_few_or_no_features_have_no_matches(n: int, m: int) -> None:
    random = random_for("few", n, m)
    first, second = (features(unit_rows(random.standard_normal((k, 8)))) for k in (n, m))
    assert mutual_matches(first, second, 0.9).shape == (0, 2)


@pytest.mark.parametrize("matching", TWO)
def test_one_photograph_at_two_poses_does_not_match_itself(matching: Matching) -> None:
    reference = make_scene(random_for("copied photograph")).references[0]
    pose = reference.world_from_camera.shifted(np.array([6.0, 0.0, 0.0]))
    copied = replace(reference, key="copy", world_from_camera=pose)
    assert Matcher().pairs.match(reference, copied, matching).shape == (0, 2)


# Epipolar lines


def posed(pose: RigidTransform, keypoints: Array, key: str = "") -> PosedView:
    return PosedView(key, "", View(CAMERA, features(np.zeros((len(keypoints), 2)), keypoints)), pose)


def all_of(count: int) -> Matches:
    return np.repeat(np.arange(count, dtype=np.int32)[:, None], 2, axis=1)


def random_pair(random: np.random.Generator, count: int = 50) -> tuple[PosedView, PosedView]:
    """Two views of the same points, exact but for the rounding of their keypoints."""
    x_in_world = random.uniform([-1, -0.7, 3], [1, 0.7, 6], (count, 3))
    poses = [RigidTransform(rotation_from_vector(random.normal(0, 0.1, 3)), random.normal(0, 0.4, 3)) for _ in range(2)]
    first, second = (posed(p, CAMERA.project(p.inverse().apply(x_in_world))) for p in poses)
    return first, second


def shifted_keypoints(view: PosedView, shift: NDArray[np.floating]) -> PosedView:
    return posed(view.world_from_camera, view.view.features.keypoints + shift)


def slow_epipolar_distance(first: PosedView, second: PosedView, i: int, j: int) -> float:
    """The distance of a keypoint from the images of two points on the other's ray; the larger of both directions."""
    distances = []
    for here, there, a, b in ((first, second, i, j), (second, first, j, i)):
        ray = CAMERA.rays(there.view.features.keypoints[b].astype(float))
        on_ray = there.world_from_camera.apply(np.array([[4.0], [5.0]]) * ray)
        start, end = CAMERA.project(here.world_from_camera.inverse().apply(on_ray))
        along, to = end - start, here.view.features.keypoints[a] - start
        distances.append(abs(along[0] * to[1] - along[1] * to[0]) / float(np.linalg.norm(along)))
    return float(max(distances))


def test_epipolar_distance_equals_brute_force() -> None:
    random = random_for("epipolar loops")
    first, second = random_pair(random)
    second = shifted_keypoints(second, random.normal(0, 5, (50, 2)))
    slow = [slow_epipolar_distance(first, second, i, i) for i in range(50)]
    np.testing.assert_allclose(epipolar_distance_px(first, second, all_of(50)), slow, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(epipolar_distance_px(second, first, all_of(50)), slow, rtol=1e-5, atol=1e-5)


def test_at_one_place_the_epipolar_constraint_rejects_nothing() -> None:
    keypoints = random_for("one place").uniform(0, 700, (10, 2))
    first, second = (
        posed(RigidTransform.identity(), keypoints),
        posed(RigidTransform(rotation_from_vector([0.0, 0.5, 0.0]), np.zeros(3)), keypoints),
    )
    np.testing.assert_array_equal(epipolar_distance_px(first, second, all_of(10)), np.zeros(10))


def test_epipolar_distances_of_all_pairs_equal_single_ones() -> None:
    random = random_for("epipolar matrix")
    first, _ = random_pair(random, 12)
    second = shifted_keypoints(random_pair(random, 20)[1], random.normal(0, 50, (20, 2)))
    pairs = np.stack(np.meshgrid(np.arange(12), np.arange(20), indexing="ij"), axis=-1).astype(np.int32)
    one_by_one = epipolar_distance_px(first, second, pairs.reshape(-1, 2)).reshape(12, 20)
    np.testing.assert_allclose(epipolar_distances_px(first, second), one_by_one, rtol=1e-4, atol=2e-3)


# The matcher


def test_references_keep_true_matches_and_drop_wrong_ones() -> None:
    scene = make_scene(random_for("filter"), SceneOptions(outlier_share=0.3, reference_count=3))
    correspondences = Matcher().correspond(scene.query, scene.references)
    assert list(correspondences.reference_pairs) == [(0, 1), (0, 2), (1, 2)]
    for (i, j), matches in correspondences.reference_pairs.items():
        first, second = scene.references[i], scene.references[j]
        assert epipolar_distance_px(first, second, matches).max() < CorrespondOptions().epipolar_px
        true = same_points(scene.reference_points[i], scene.reference_points[j])
        found = {tuple(m) for m in matches.tolist()}
        assert len(found & {tuple(m) for m in true.tolist()}) > 0.95 * len(true)
        assert len(found) < 1.1 * len(true)


def test_wide_matches_contain_the_strict_ones() -> None:
    scene = make_scene(random_for("wide"), SceneOptions(descriptor_noise=0.5, distractor_count=1500, reference_count=3))
    options = CorrespondOptions(reference_ratio=0.5, wide_similarity=0.6)
    matcher = Matcher(options)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        first, second = scene.references[i], scene.references[j]
        strict = {tuple(m) for m in matcher.pairs.match(first, second).tolist()}
        wide = matcher.pairs.match(first, second, Matching.WIDE)
        assert strict < {tuple(m) for m in wide.tolist()}
        assert epipolar_distance_px(first, second, wide).max() < options.epipolar_px + 1e-3
        for column in wide.T:
            assert len(np.unique(column)) == len(column)
        true = {tuple(m) for m in same_points(scene.reference_points[i], scene.reference_points[j]).tolist()}
        assert len({tuple(m) for m in wide.tolist()} & true) > 0.95 * len(wide)
        np.testing.assert_array_equal(matcher.pairs.match(first, second, Matching.WIDE), wide)
        assert {tuple(m) for m in matcher.pairs.match(first, second).tolist()} == strict


def test_without_features_there_are_no_matches() -> None:
    scene = make_scene(random_for("blank"), SceneOptions(reference_count=2))
    blank = View(CAMERA, features(np.empty((0, 128)), np.empty((0, 2))))
    references = (replace(scene.references[0], view=blank), scene.references[1])
    correspondences = Matcher().correspond(blank, references)
    assert [len(m) for m in correspondences.query_matches] == [0, 0]
    assert correspondences.reference_pairs[0, 1].shape == (0, 2)
    assert Matcher().pairs.match(*references, Matching.WIDE).shape == (0, 2)
    assert Matcher().pairs.match(*references[::-1], Matching.WIDE).shape == (0, 2)


@pytest.fixture
def matched_pairs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Features, Features]]:
    """Every pair whose descriptors have been compared."""
    calls: list[tuple[Features, Features]] = []

    def spy(usual: Callable[..., Any]) -> Callable[..., Any]:
        def compare(first: Features, second: Features, *options: Any, **named: Any) -> Any:
            calls.append((first, second))
            return usual(first, second, *options, **named)

        return compare

    for module, name in (reference_pairs, "mutual_matches_of_ratios"), (matching, "row_maxima"):
        monkeypatch.setattr(module, name, spy(getattr(matching, name)))
    return calls


def test_pairs_of_references_are_matched_once(matched_pairs: list[tuple[Features, Features]]) -> None:
    scene = make_scene(random_for("memory"), SceneOptions(reference_count=4, point_count=50))
    matcher = Matcher()
    once = matcher.correspond(scene.query, scene.references)
    assert len(matched_pairs) == 6 + 4
    again = matcher.correspond(scene.query, scene.references)
    assert len(matched_pairs) == 10 + 4  # the query's alone
    for pair, matches in once.reference_pairs.items():
        np.testing.assert_array_equal(again.reference_pairs[pair], matches)


def test_matches_depend_neither_on_the_order_nor_on_the_other_references() -> None:
    scene = make_scene(random_for("no order"), SceneOptions(outlier_share=0.3, reference_count=4))
    forth, back = scene.references, scene.references[::-1]
    for kind in TWO:
        for some in combinations(forth, 2):
            alone = Matcher().correspond(scene.query, some, kind).reference_pairs[0, 1]
            pair = forth.index(some[0]), forth.index(some[1])
            among = Matcher().correspond(scene.query, forth, kind).reference_pairs[pair]
            turned = Matcher().correspond(scene.query, back, kind).reference_pairs[3 - pair[1], 3 - pair[0]]
            np.testing.assert_array_equal(among, alone)
            np.testing.assert_array_equal(turned[:, ::-1], alone)


class Shelf:
    """Pairs that were stored; which were looked for."""

    def __init__(self, matches: dict[tuple[str, str], Matches]) -> None:
        self.matches = matches
        self.asked: list[tuple[str, list[tuple[str, str]]]] = []

    def find(self, matching: str, pairs: Sequence[tuple[PosedView, PosedView]]) -> list[StoredPair | None]:
        keys = [(first.key, second.key) for first, second in pairs]
        self.asked.append((matching, keys))
        return [StoredPair(self.matches[key]) if key in self.matches else None for key in keys]


@pytest.mark.parametrize("kind", TWO)
def test_stored_pairs_are_used_and_give_the_same(
    kind: Matching, matched_pairs: list[tuple[Features, Features]]
) -> None:
    scene = make_scene(random_for("stored"), SceneOptions(outlier_share=0.3, reference_count=4))
    expected = Matcher().correspond(scene.query, scene.references, kind)
    made = {(a.key, b.key): Matcher().pairs.make(a, b, kind) for a, b in list(combinations(scene.references, 2))[:4]}
    matched_pairs.clear()
    matcher = Matcher()
    matcher.pairs.stored = shelf = Shelf(made)
    for _ in range(2):
        # In any order of the references, the pairs are looked for as they were stored, and once.
        found = matcher.correspond(scene.query, scene.references[::-1], kind)
        for (i, j), matches in found.reference_pairs.items():
            np.testing.assert_array_equal(matches[:, ::-1], expected.reference_pairs[3 - j, 3 - i])
    ((matching, keys),) = shelf.asked
    assert matching == matcher.pairs.name(kind)
    assert {tuple(sorted(key)) for key in keys} == set(keys)
    assert len(matched_pairs) == 2 + 2 * 4  # the two that are not stored, and the query's twice


class FullShelf(Shelf):
    """Pairs that were stored of several matchings."""

    def __init__(self, matcher: Matcher, pairs: Sequence[tuple[PosedView, PosedView]], wide: bool = True) -> None:
        kinds = [Matching.STRONG, Matching.STRONG_WIDE] if wide else [Matching.STRONG]
        self.of = {
            matcher.pairs.name(kind): {(a.key, b.key): matcher.pairs.make(a, b, kind) for a, b in pairs}
            for kind in kinds
        }

    def find(self, matching: str, pairs: Sequence[tuple[PosedView, PosedView]]) -> list[StoredPair | None]:
        found = [self.of.get(matching, {}).get((first.key, second.key)) for first, second in pairs]
        return [None if it is None else StoredPair(it) for it in found]


class TestPairMatching:
    SCENE = make_scene(random_for("strong"), SceneOptions(outlier_share=0.3, reference_count=4, descriptor_noise=0.5))

    def test_a_query_is_matched_again_with_its_best_references_only(self) -> None:
        pairs, options = AnyRatio(), CorrespondOptions(rematched_references=2, rematched_keypoints=10_000)
        matcher = Matcher(options, pair_matching=pairs)
        quick = matcher.match_quickly(self.SCENE.query, self.SCENE.references)
        found = matcher.match_query(self.SCENE.query, self.SCENE.references)
        best = sorted(range(4), key=lambda i: -len(quick[i]))[:2]
        for i, reference in enumerate(self.SCENE.references):
            ratio = 1.0 if i in best else options.query_ratio
            np.testing.assert_array_equal(
                found[i], mutual_matches(self.SCENE.query.features, reference.view.features, ratio)
            )
        assert len(pairs.seen) == 2
        assert matcher.pair_s is not None

    def test_only_the_strongest_keypoints_are_matched_again(self) -> None:
        matcher = Matcher(CorrespondOptions(rematched_keypoints=40), pair_matching=AnyRatio())
        found = matcher.rematch(self.SCENE.query, self.SCENE.references[0])
        assert len(found)
        assert found.max() < 40

    @pytest.mark.parametrize("matching", TWO)
    def test_a_query_has_no_time_to_make_strong_pairs(self, matching: Matching) -> None:
        pairs = AnyRatio()
        matcher = Matcher(CorrespondOptions(rematched_references=0), pair_matching=pairs)
        found, usual = (it.correspond(self.SCENE.query, self.SCENE.references, matching) for it in (matcher, Matcher()))
        assert not pairs.seen
        for pair, matches in usual.reference_pairs.items():
            np.testing.assert_array_equal(found.reference_pairs[pair], matches)

    @pytest.mark.parametrize("matching", TWO)
    @pytest.mark.parametrize("wide_are_stored", [False, True])
    def test_strong_pairs_are_used_as_soon_as_they_are_stored(self, matching: Matching, wide_are_stored: bool) -> None:
        """Wide ones are the same, whether they were stored or are made from the stored strict ones."""
        scene, matcher = self.SCENE, Matcher(pair_matching=AnyRatio())
        strong = Matching.STRONG_WIDE if matching.is_wide else Matching.STRONG
        usual = matcher.correspond(scene.query, scene.references, matching).reference_pairs
        ordered = list(combinations(scene.references, 2))[:4]
        matcher.pairs.stored = FullShelf(Matcher(pair_matching=AnyRatio()), ordered, wide_are_stored)
        found = matcher.correspond(scene.query, scene.references, matching).reference_pairs
        for pair in combinations(range(4), 2):
            first, second = (scene.references[i] for i in pair)
            is_stored = any(first is a and second is b for a, b in ordered)
            expected = matcher.pairs.make(first, second, strong) if is_stored else usual[pair]
            np.testing.assert_array_equal(found[pair], expected)
        assert sum(map(len, found.values())) > sum(map(len, usual.values()))

    def test_strong_pairs_have_names_of_their_own(self) -> None:
        one, other = AnyRatio(), AnyRatio()
        other.name = "other weights"
        matchers = [Matcher(pair_matching=it) for it in (one, other)]
        names = [matcher.pairs.name(kind) for matcher in matchers for kind in Matching]
        assert len(set(names)) == 2 + 4

    @pytest.mark.parametrize("matching", TWO)
    def test_the_key_says_which_matches_were_found(self, matching: Matching) -> None:
        """Strong matches that have left the cache since they were looked up are not used, and not said to be."""
        pairs = [in_order(*it) for it in combinations(self.SCENE.references, 2)]
        matcher = Matcher(CorrespondOptions(remembered_pairs=1), pair_matching=AnyRatio())
        matcher.pairs.stored = FullShelf(Matcher(pair_matching=AnyRatio()), pairs, wide=False)
        matcher.pairs.look_up(pairs, matching)
        keys = []
        for first, second in reversed(pairs):
            key, found = matcher.pairs.find(first, second, matching)
            np.testing.assert_array_equal(found.all, matcher.pairs.make(first, second, key.matching))
            keys.append(key.matching)
        assert len(set(keys)) == 2


def test_what_determines_matches_is_in_their_name() -> None:
    usual = CorrespondOptions()
    changed = [
        replace(usual, **{name: getattr(usual, name) * 0.99})
        for name in ("reference_ratio", "epipolar_px", "distinct_ratio", "wide_similarity")
    ]
    names = {Matcher(options).pairs.name(kind) for options in (usual, *changed) for kind in TWO}
    assert len(names) == 5 + 3  # strict matches do not depend on the options of wide ones
    assert Matcher(replace(usual, query_ratio=0.5)).pairs.name() == Matcher(usual).pairs.name()


def test_the_cache_is_bounded_and_drops_the_least_recently_used(matched_pairs: list[tuple[Features, Features]]) -> None:
    scene = make_scene(random_for("bounded"), SceneOptions(reference_count=4, point_count=50))
    a, b, c, d = scene.references
    matcher = Matcher(CorrespondOptions(remembered_pairs=2))
    for first, second in ((a, b), (a, c), (a, b), (a, d)):  # forgets (a, c), since (a, b) was used after it
        matcher.pairs.match(first, second)
    assert len(matched_pairs) == 3
    matcher.pairs.match(a, b)
    matcher.pairs.match(a, d)
    assert len(matched_pairs) == 3
    matcher.pairs.match(a, c)
    assert len(matched_pairs) == 4


def test_pairs_of_a_deleted_reference_leave_the_cache(matched_pairs: list[tuple[Features, Features]]) -> None:
    scene = make_scene(random_for("deleted"), SceneOptions(reference_count=3, point_count=50))
    a, b, c = scene.references
    matcher = Matcher()
    for first, second in ((a, b), (b, c), (a, c)):
        matcher.pairs.match(first, second)
    matcher.forget({b.key, "another"})
    assert len(matched_pairs) == 3
    matcher.pairs.match(a, c)
    assert len(matched_pairs) == 3
    matcher.pairs.match(a, b)
    matcher.pairs.match(b, c)
    assert len(matched_pairs) == 5


# Choosing references


def best_by_count(count: int) -> Callable[[Sequence[int], Sequence[int]], list[int]]:
    """Chooses the references with the most matches."""
    return lambda indices, counts: [i for _, i in sorted(zip((-it for it in counts), indices, strict=True))[:count]]


@pytest.mark.parametrize(("enough", "matched"), [(1.0, 6 + 2), (1e6, 6 + 6)])
def test_references_are_chosen_by_a_sample_unless_it_has_few_matches(
    matched_pairs: list[tuple[Features, Features]], enough: float, matched: int
) -> None:
    scene = make_scene(random_for("chosen"), SceneOptions(reference_count=6, point_count=200))
    keep = [slice(None, None, step) for step in (4, 1, 4, 4, 1, 4)]  # two references share the most with the query
    references = [
        replace(r, view=replace(r.view, features=Features(*(a[rows] for a in vars(r.view.features).values()))))
        for r, rows in zip(scene.references, keep, strict=True)
    ]
    matcher = Matcher(CorrespondOptions(enough_sampled=enough))
    found = matcher.match_best(scene.query, references, 2, best_by_count(2))
    assert len(matched_pairs) == matched
    assert sorted(found) == [1, 4]
    assert [len(it) for it in found.values()] == sorted((len(it) for it in found.values()), reverse=True)
    for i, matches in found.items():
        (expected,) = matcher.match_quickly(scene.query, [references[i]])
        np.testing.assert_array_equal(matches, expected)


# Query matching


class Fixed:
    """Matches keypoint 0 with keypoint 0."""

    calls = 0

    def match(self, query: View, references: Sequence[PosedView], check: Callable[[], None]) -> Sequence[Matches]:
        check()
        self.calls += 1
        return [np.zeros((1, 2), np.int32)] * len(references)


def test_a_query_matcher_leaves_references_to_the_matcher() -> None:
    scene = make_scene(random_for("seam"), SceneOptions(reference_count=3))
    fixed = Fixed()
    matcher = Matcher(query_matching=fixed)
    ours, usual = matcher.correspond(scene.query, scene.references), Matcher().correspond(scene.query, scene.references)
    assert [m.tolist() for m in ours.query_matches] == [[[0, 0]]] * 3
    assert ours.reference_pairs.keys() == usual.reference_pairs.keys()
    for pair, matches in usual.reference_pairs.items():
        np.testing.assert_array_equal(ours.reference_pairs[pair], matches)


def test_the_check_cancels_the_matching_of_the_query() -> None:
    scene = make_scene(random_for("ends"), SceneOptions(reference_count=3))
    calls = iter(range(5))

    def check() -> None:
        if next(calls) == 4:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        Matcher().correspond(scene.query, scene.references, check=check)


def test_every_extractor_has_its_options() -> None:
    assert set(OPTIONS) == set(FEATURES)
    for name in FEATURES:
        assert make_matcher(name).options == OPTIONS[name]
    with pytest.raises(ValueError, match="unknown features 'surf'"):
        make_matcher("surf")


def test_a_thread_of_low_priority_computes_alone() -> None:
    shared, seen = SharedThreads(3), set[int]()

    def compute() -> None:
        lower_priority(lambda: False)
        shared.map(lambda _: seen.add(threading.get_ident()), range(20))
        assert seen == {threading.get_ident()}

    with ThreadPoolExecutor(1) as pool:
        pool.submit(compute).result(timeout=30)
    shared.close()


@pytest.mark.parametrize("threads", [1, 3])
def test_shared_threads_compute_each_item_once_and_in_order(threads: int) -> None:
    shared, seen = SharedThreads(threads), list[int]()

    def compute(item: int) -> Matches:
        seen.append(item)
        if item == 77:
            raise TimeoutError
        return np.full((1, 2), item, np.int32)

    items = [*range(70), 80]
    assert [int(found[0, 0]) for found in shared.map(compute, items)] == items
    assert sorted(seen) == items
    assert shared.map(compute, []) == []
    seen.clear()
    with pytest.raises(TimeoutError):
        shared.map(compute, range(1000))
    assert len(seen) < 1000, "no item is begun after a failure"
    shared.close()
