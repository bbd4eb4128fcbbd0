"""The ranking of references: its laws on planted similarities, places and headings, against a slow twin."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.scenes import CAMERA, SceneOptions, make_scene, random_for, unit_rows

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.priors import PosePrior
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.scenes import Cone, Narrowing, RankedReference, RankOptions, Selection, Sphere, rank_references
from mapless_server.scenes.retrieval.index import Entries, SceneIndex
from mapless_server.scenes.retrieval.ranking import nearest_references, spread, spread_choice
from mapless_server.scenes.retrieval.vlad import LEARNED, VladDescriptor, Vocabulary, dataless, shipped
from mapless_server.store import IndexedReference, SceneChanges
from mapless_tools.evaluate.references import choose_references

DIMENSION = 16
QUERY = np.eye(DIMENSION, dtype=np.float32)[0]
AHEAD = np.array([0.0, 0.0, 1.0])
UNTHINNED = RankOptions(nearby_weight=1.0, same_place_m=0.0)


def with_similarity(similarity: float) -> NDArray[np.float32]:
    """A unit vector of that cosine with the query's."""
    vector = np.zeros(DIMENSION, np.float32)
    vector[:2] = similarity, math.sqrt(1 - similarity**2)
    return vector


def planted(
    similarities: list[float | None], x_m: list[float] | None = None, turned_deg: list[float] | None = None
) -> Entries:
    """References "0", "1", ... on a line, looking along z, turned about y."""
    n = len(similarities)
    places, turns = x_m or [10.0 * i for i in range(n)], turned_deg or [0.0] * n
    references = [
        IndexedReference(
            str(i),
            f"key-{i}",
            RigidTransform(rotation_from_vector([0.0, math.radians(turn), 0.0]), np.array([x, 0.0, 0.0])),
            None if similarity is None else with_similarity(similarity),
        )
        for i, (similarity, x, turn) in enumerate(zip(similarities, places, turns, strict=True))
    ]
    index = SceneIndex(DIMENSION)
    index.apply(SceneChanges(1, tuple(references), frozenset(), True))
    return index.entries()


def rank(
    entries: Entries, vector: NDArray[np.float32] | None, count: int, narrowing: Narrowing | None = None, **more: Any
) -> list[RankedReference]:
    return rank_references(entries, vector, Selection(count, narrowing or Narrowing(), **more))


def ids(ranked: list[RankedReference]) -> str:
    return " ".join(it.reference_id for it in ranked)


class TestOrder:
    @pytest.mark.parametrize("count", [0, 1, 3, 4, 100])
    def test_no_more_are_chosen_than_there_are(self, count: int) -> None:
        assert len(rank(planted([0.1, 0.2, 0.3, 0.4]), QUERY, count)) == min(count, 4)

    def test_those_without_descriptor_come_last_nearest_first(self) -> None:
        entries = planted([None, -0.9, None, None], x_m=[9.0, 0.0, 1.0, 4.0])
        near = Narrowing(Sphere(np.zeros(3), 1.0))
        ranked = rank(entries, QUERY, 4, near)
        assert ids(ranked) == "1 2 3 0"
        assert [math.isnan(it.similarity) for it in ranked] == [False, True, True, True]

    def test_a_photograph_without_descriptor_ranks_by_place(self) -> None:
        entries = planted([0.9, 0.8, 0.7], x_m=[5.0, 1.0, 3.0])
        assert ids(rank(entries, None, 3, Narrowing(Sphere(np.zeros(3), 1.0)))) == "1 2 0"
        assert ids(rank(entries, None, 3)) == "0 1 2"

    def test_only_named_references_are_ranked_unknown_ones_skipped(self) -> None:
        entries = planted([0.2, 0.9, -0.1, 0.5])
        assert ids(rank(entries, QUERY, 10, among=["0", "3", "elsewhere"])) == "3 0"
        assert rank(entries, QUERY, 10, among=["elsewhere"]) == []

    def test_a_large_scene_is_ranked_as_by_sorting(self) -> None:
        """Only a pool is looked at; without thinning that must not show."""
        similarity = np.round(random_for("large").uniform(-1, 1, 3000), 2)
        entries = planted(similarity.tolist(), x_m=[0.0] * 3000)
        exact = entries.similarities(QUERY, entries.rows())
        expected = np.argsort(-exact, kind="stable")[:7].tolist()
        options = replace(UNTHINNED, pool=1, smallest_pool=1)
        assert [int(it.reference_id) for it in rank(entries, QUERY, 7, options=options)] == expected


class TestNarrowing:
    def test_a_position_prior_keeps_what_is_in_radius_and_margin(self) -> None:
        entries = planted([0.1, 0.2, 0.3, 0.4], x_m=[0.0, 11.9, 12.1, 50.0])
        prior = Narrowing(Sphere(np.zeros(3), 2.0), margin_m=10.0)
        assert ids(rank(entries, QUERY, 10, prior)) == "1 0"

    def test_a_heading_keeps_what_looks_the_same_way(self) -> None:
        entries = planted([0.1, 0.2, 0.3, 0.4], turned_deg=[0.0, 29.0, -31.0, 180.0])
        heading = Narrowing(heading=Cone(AHEAD, 30.0), margin_deg=0.0)
        assert ids(rank(entries, QUERY, 10, heading)) == "1 0"

    def test_both_must_hold(self) -> None:
        entries = planted([0.1, 0.2, 0.3], x_m=[0.0, 0.0, 99.0], turned_deg=[0.0, 90.0, 0.0])
        both = Narrowing(Sphere(np.zeros(3), 1.0), Cone(AHEAD, 20.0), margin_m=0.0, margin_deg=0.0)
        assert ids(rank(entries, QUERY, 10, both)) == "0"


class TestThinning:
    def test_neighbours_are_thinned_in_the_ranking_too(self) -> None:
        entries = planted([0.9, 0.89, 0.8, 0.1, 0.1, 0.1, 0.1], x_m=[0.0, 0.1, 5.0, 20.0, 30.0, 40.0, 50.0])
        assert ids(rank(entries, QUERY, 2)) == "0 2"
        assert ids(rank(entries, QUERY, 2, options=UNTHINNED)) == "0 1"

    def test_few_references_of_a_standing_camera_are_chosen(self) -> None:
        """Three hundred alike, more than are looked at first; then those that are less so, the better first."""
        similarities: list[float | None] = [*[0.99] * 300, 0.5, 0.7, 0.6, *[0.1] * 400]
        places = [0.0001 * i for i in range(300)] + [1.0, 2.0, 3.0] + [10.0 + i for i in range(400)]
        ranked = rank(planted(similarities, places), QUERY, 6)
        assert ids(ranked) == "0 1 2 301 302 300"
        assert ids(rank(planted([0.9, 0.8, 0.7], [0.0, 0.01, 0.02]), QUERY, 2)) == "0 1"

    @settings(deadline=None)
    @given(
        st.lists(
            st.tuples(st.integers(-10, 10), st.integers(0, 9), st.sampled_from([0, 20, 90])), min_size=1, max_size=8
        ),
        st.integers(0, 9),
        st.sampled_from([0.0, 0.5, 1.0]),
        st.sampled_from([-0.5, 0.2]),
        st.sampled_from([0.0, 0.15]),
        st.integers(1, 3),
    )
    def test_the_choice_equals_brute_force(
        self,
        candidates: list[tuple[int, int, int]],
        count: int,
        weight: float,
        typical: float,
        same_m: float,
        most: int,
    ) -> None:
        scores = [0.1 * score for score, _, _ in candidates]
        centres = np.array([[0.1 * place, 0.0, 0.0] for _, place, _ in candidates])
        angles = np.radians([turn for _, _, turn in candidates])
        axes = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
        options = RankOptions(0.25, 30.0, weight, same_m, most)
        expected = slow_spread(scores, centres, axes, count, typical, options)
        assert spread(scores, centres, axes, count, typical, options) == expected


class TestNearAPrior:
    @staticmethod
    def near(entries: Entries, x_m: float, sigma_m: float = 0.1, turned_deg: float = 0.0, count: int = 3) -> str:
        turn = rotation_from_vector([0.0, math.radians(turned_deg), 0.0])
        covariance = np.diag([sigma_m**2] * 3 + [1e-4] * 3)
        pose = RigidTransform(turn, np.array([x_m, 0.0, 0.0]))
        return ids(nearest_references(entries, PosePrior(pose, covariance), count))

    def test_they_are_those_nearest_to_the_nearest_for_all_priors_around_it(self) -> None:
        entries = planted([None] * 6, [0.0, 1.0, 2.1, 3.3, 4.6, 6.0])
        assert {self.near(entries, x_m) for x_m in (1.7, 2.0, 2.6)} == {"2 1 3"}

    def test_those_that_look_elsewhere_count_as_further_or_not_at_all(self) -> None:
        entries = planted([None] * 4, [0.0, 1.0, 1.5, 1.2], [0.0, 30.0, 0.0, 61.0])
        assert self.near(entries, 0.1) == "0 2 1"

    @pytest.mark.parametrize(("x_m", "sigma_m", "turned_deg"), [(1.0, 3.0, 0.0), (8.0, 0.1, 0.0), (1.0, 0.1, 61.0)])
    def test_there_are_none_where_the_prior_does_not_say_which(
        self, x_m: float, sigma_m: float, turned_deg: float
    ) -> None:
        assert self.near(planted([None] * 3, [0.0, 1.0, 2.0]), x_m, sigma_m, turned_deg) == ""


def slow_spread(
    scores: list[float], centres: Array, axes: Array, count: int, typical: float, options: RankOptions
) -> list[int]:
    """The rule in words."""
    chosen: list[int] = []

    def sees_what_is_seen(i: int) -> bool:
        return any(
            np.linalg.norm(centres[i] - centres[c]) < options.apart_m
            and math.degrees(math.acos(min(1.0, axes[i] @ axes[c]))) <= options.apart_deg
            for c in chosen
        )

    def is_passed_over(i: int) -> bool:
        there = [
            c
            for c in chosen
            if np.linalg.norm(centres[i] - centres[c]) < options.same_place_m
            and math.degrees(math.acos(min(1.0, axes[i] @ axes[c]))) <= options.apart_deg
        ]
        return len(there) >= max(1, min(options.per_place, count // 2))

    def worth(i: int) -> float:
        lead = max(scores[i] - typical, 0.0)
        return scores[i] - (1 - options.nearby_weight) * lead if sees_what_is_seen(i) else scores[i]

    while len(chosen) < count:
        left = [i for i in range(len(scores)) if i not in chosen and not is_passed_over(i)]
        if not left:
            break
        chosen.append(max(left, key=lambda i: (worth(i), -i)))
    return chosen


def bare_view(descriptors: Array) -> View:
    n = len(descriptors)
    return View(CAMERA, Features(np.zeros((n, 2), np.float32), descriptors.astype(np.float32), np.ones(n, np.float32)))


def slow_choice(counts: list[int], centres: Array, count: int, apart_m: float, nearby_weight: float) -> list[int]:
    """A slow implementation: best score first, where a reference near a chosen one has a lower score."""
    chosen: list[int] = []
    while len(chosen) < min(count, len(counts)):
        scores = {
            i: counts[i]
            * (nearby_weight if any(np.linalg.norm(centres[i] - centres[c]) < apart_m for c in chosen) else 1.0)
            for i in range(len(counts))
            if i not in chosen
        }
        chosen.append(max(scores, key=lambda i: (scores[i], -i)))
    return chosen


@given(
    st.lists(st.tuples(st.integers(0, 20), st.integers(0, 12)), max_size=8),
    st.integers(0, 9),
    st.sampled_from([0.0, 0.25, 0.5, 1.0]),
    st.sampled_from([0.0, 0.3, 5.0]),
)
def test_the_choice_equals_brute_force(
    candidates: list[tuple[int, int]], count: int, nearby_weight: float, apart_m: float
) -> None:
    counts = [matches for matches, _ in candidates]
    centres = np.array([[0.1 * place, 0.0, 0.0] for _, place in candidates]).reshape(-1, 3)
    given = counts, centres, count, apart_m, nearby_weight
    assert spread_choice(*given) == slow_choice(*given)


def test_references_that_see_more_of_the_query_are_chosen() -> None:
    scene = make_scene(random_for("retrieve"), SceneOptions(reference_count=4))
    elsewhere = make_scene(random_for("elsewhere"), SceneOptions(reference_count=4))
    candidates = [*elsewhere.references, *scene.references]
    assert set(choose_references(scene.query, candidates, 4)) == {4, 5, 6, 7}
    assert choose_references(scene.query, [], 4) == []


def test_the_ratio_decides_what_counts_as_a_match() -> None:
    """One reference shows little, clearly; another shows much, faintly: behind many that look nearly the same."""
    random = random_for("ratio")
    query = unit_rows(random.standard_normal((60, 32)))
    clear = np.concatenate([query[:20], unit_rows(random.standard_normal((100, 32)))])
    faint = np.concatenate([query, unit_rows(query + 0.03 * random.standard_normal(query.shape))])
    faint = unit_rows(faint + 0.03 * random.standard_normal(faint.shape))
    posed = [
        PosedView(str(i), str(i), bare_view(d), RigidTransform(np.eye(3), np.array([i, 0.0, 0.0])))
        for i, d in enumerate((clear, faint))
    ]
    assert choose_references(bare_view(query), posed, 1, ratio=0.5) == [0]
    assert choose_references(bare_view(query), posed, 1, ratio=1.0) == [1]


DIGESTS = {"sift": "53ac1a6f", "aliked": "d26d2f4e", "xfeat": "8c987f94", "edgepoint2-l64": "94322c2c"}
"""Digests of the shipped vocabularies. Another one makes another name; stored descriptors are computed again."""

LENGTHS = {"sift": 128, "aliked": 128, "xfeat": 64, "edgepoint2-l64": 64}


def view_of(descriptors: Array) -> View:
    n = len(descriptors)
    features = Features(np.zeros((n, 2), np.float32), descriptors.astype(np.float32), np.ones(n, np.float32))
    return View(CAMERA, features)


def descriptors(case: str, count: int = 500, length: int = 128) -> Array:
    return unit_rows(np.abs(random_for("vlad", case).standard_normal((count, length))))


@pytest.fixture(params=["sift", "dataless"])
def descriptor(request: pytest.FixtureRequest) -> VladDescriptor:
    return VladDescriptor("any-1", shipped("sift") if request.param == "sift" else None)


class TestDescriptor:
    def test_it_is_that_of_loops(self, descriptor: VladDescriptor) -> None:
        found = descriptors("loops", 60)
        vocabulary = shipped("sift") if "dataless" not in descriptor.name else dataless(128)
        assert vocabulary is not None
        np.testing.assert_allclose(descriptor.describe(view_of(found)), slow_vlad(found, vocabulary), atol=1e-4)

    def test_a_planted_place_resembles_itself(self, descriptor: VladDescriptor) -> None:
        here, elsewhere = (make_scene(random_for(case), SceneOptions(reference_count=4)) for case in ("here", "there"))
        query = descriptor.describe(here.query)
        own = [float(query @ descriptor.describe(it.view)) for it in here.references]
        foreign = [float(query @ descriptor.describe(it.view)) for it in elsewhere.references]
        assert min(own) > max(foreign) + 0.02

    def test_a_blank_wall_resembles_nothing(self, descriptor: VladDescriptor) -> None:
        assert not descriptor.describe(view_of(np.empty((0, 128)))).any()

    def test_features_of_another_length_are_refused(self) -> None:
        with pytest.raises(ValueError, match="have 64 numbers, the vocabulary's have 128"):
            VladDescriptor("sift-1", shipped("sift")).describe(view_of(descriptors("a", length=64)))

    @pytest.mark.parametrize("length", [8, 64, 256])
    def test_without_data_any_length_goes(self, length: int) -> None:
        vector = VladDescriptor("new-1", None).describe(view_of(descriptors("a", length=length)))
        assert float(vector @ vector) == pytest.approx(1.0, abs=1e-5)


class TestNames:
    def test_the_name_has_rule_vocabulary_and_features(self) -> None:
        extractor = SiftExtractor()
        made = VladDescriptor.of(extractor)
        assert made.name == f"vlad-1-{DIGESTS['sift']}-{extractor.name}"
        assert made.extractor == extractor.name

    def test_another_vocabulary_is_another_name(self) -> None:
        one, other = dataless(128), replace(dataless(128), mean=np.full(128, 0.01, np.float32))
        names = {VladDescriptor("x", vocabulary).name for vocabulary in (one, other, None, shipped("sift"))}
        assert len(names) == 4
        assert VladDescriptor("y", one).name != VladDescriptor("x", one).name


class TestVocabularies:
    @pytest.mark.parametrize("kind", LEARNED)
    def test_what_is_shipped_is_what_was_measured(self, kind: str) -> None:
        vocabulary = shipped(kind)
        assert vocabulary is not None
        assert vocabulary.digest() == DIGESTS[kind]
        assert len(vocabulary.mean) == LENGTHS[kind]
        assert all(np.isfinite(array).all() for array in (vocabulary.mean, vocabulary.projection, vocabulary.words))

    def test_arrays_that_do_not_fit_are_refused(self) -> None:
        good = dataless(16)
        with pytest.raises(ValueError, match="do not fit"):
            Vocabulary(good.mean[:8], good.projection, good.words)


def slow_vlad(found: Array, vocabulary: Vocabulary) -> Array:
    """The rule in words."""
    sums = np.zeros_like(vocabulary.words, dtype=float)
    for one in found.astype(np.float32):
        point = (one - vocabulary.mean) @ vocabulary.projection
        word = int(np.argmin(np.linalg.norm(vocabulary.words - point, axis=1)))
        away = point - vocabulary.words[word]
        sums[word] += away / np.linalg.norm(away)
    powered = np.sign(sums) * np.sqrt(np.abs(sums))
    return np.asarray((powered / np.linalg.norm(powered)).ravel())
