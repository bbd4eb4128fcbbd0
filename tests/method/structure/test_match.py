"""Matching: planted pairs, votes, and the guided search against loops."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.planted import true_correspondences, true_structure
from support.scenes import CAMERA, SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.pairs.correspond import Correspondences
from mapless_server.method.structure.match import PAPER_MATCH, MatchOptions, match_points, one_to_one, search, vote
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import ONE_PIXEL

NOTHING = PointMatches(np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0, bool), 0.0)

Pair = tuple[int, int]
"""A point and a keypoint of the query."""


def pairs_of(matches: PointMatches) -> set[Pair]:
    return set(zip(matches.point.tolist(), matches.keypoint.tolist(), strict=True))


def counts_of(scene: SyntheticScene) -> list[int]:
    return [len(r.view.features) for r in scene.references]


def assert_is_one_to_one(matches: PointMatches) -> None:
    assert len(np.unique(matches.point)) == len(np.unique(matches.keypoint)) == len(matches)


def about(pose: RigidTransform, metres: float, degrees: float) -> RigidTransform:
    """A pose that is off by about so much."""
    turn = rotation_from_vector(np.radians(degrees) * np.array([0.6, -0.64, 0.48]))
    return RigidTransform(pose.rotation @ turn, pose.translation + metres * np.array([0.48, 0.6, -0.64]))


# Pairs


def slow_one_to_one(first: list[int], second: list[int], score: list[float]) -> set[tuple[int, int]]:
    """The best of each first; of these the best of each second."""
    by_first: dict[int, tuple[int, float]] = {}
    for a, b, s in zip(first, second, score, strict=True):
        if a not in by_first or s > by_first[a][1]:
            by_first[a] = (b, s)
    by_second: dict[int, tuple[int, float]] = {}
    for a, (b, s) in by_first.items():
        if b not in by_second or s > by_second[b][1]:
            by_second[b] = (a, s)
    return {(a, b) for b, (a, _) in by_second.items()}


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), unique=True, max_size=30), st.randoms())
def test_no_point_or_keypoint_is_matched_twice(pairs: list[tuple[int, int]], shuffler: object) -> None:
    first, second = [a for a, _ in pairs], [b for _, b in pairs]
    score = np.arange(len(pairs), dtype=float)
    shuffler.shuffle(score)  # type: ignore[attr-defined]
    a, b = one_to_one(np.array(first, np.intp), np.array(second, np.intp), score)
    assert len(np.unique(a)) == len(np.unique(b)) == len(a)
    found = set(zip(a.tolist(), b.tolist(), strict=True))
    assert found == slow_one_to_one(first, second, score.tolist())
    if pairs:
        assert pairs[int(np.argmax(score))] in found


# Votes


def small_structure(tracks: list[list[tuple[int, int]]]) -> Structure:
    """Points at the origin with the given observations (view, keypoint)."""
    rows = [(p, view, keypoint) for p, track in enumerate(tracks) for view, keypoint in track]
    point, view, keypoint = (np.array(c, np.intp) for c in zip(*rows, strict=True))
    return Structure(np.zeros((len(tracks), 3)), Tracks(point, view, keypoint), ONE_PIXEL)


def query_matches(*matches: list[tuple[int, int]]) -> Correspondences:
    return Correspondences({}, tuple(np.array(m, np.int32).reshape(-1, 2) for m in matches))


def test_a_keypoint_takes_the_point_of_most_references() -> None:
    structure = small_structure([[(0, 0), (1, 0), (2, 0)], [(0, 1), (1, 1), (2, 1)]])
    # Two references say that keypoint 5 shows point 0, one says point 1.
    found = vote(structure, [2, 2, 2], query_matches([(5, 1)], [(5, 0)], [(5, 0)]))
    assert pairs_of(found) == {(0, 5)}
    assert not found.guided.any()


def test_a_point_takes_the_keypoint_of_most_references() -> None:
    structure = small_structure([[(0, 0), (1, 0), (2, 0)]])
    assert pairs_of(vote(structure, [1, 1, 1], query_matches([(3, 0)], [(4, 0)], [(4, 0)]))) == {(0, 4)}


def test_matches_with_untriangulated_keypoints_are_ignored() -> None:
    structure = small_structure([[(0, 2), (1, 0)]])
    assert pairs_of(vote(structure, [3, 2], query_matches([(0, 0), (1, 1)], [(2, 1)]))) == set()
    assert pairs_of(vote(structure, [3, 2], query_matches([], []))) == set()


def test_planted_pairs_are_found_through_tracks() -> None:
    scene = make_scene(random_for("vote"))
    structure, true = true_structure(scene)
    found = vote(structure, counts_of(scene), true_correspondences(scene))
    assert_is_one_to_one(found)
    assert pairs_of(found) <= pairs_of(true)
    assert len(found) > 0.95 * len(true)


def test_wrong_matches_of_one_reference_lose_the_vote() -> None:
    scene = make_scene(random_for("outvoted"), SceneOptions(seen_share=1.0))
    structure, true = true_structure(scene)
    random = random_for("outvoted matches")
    right = true_correspondences(scene).query_matches
    wrong = right[0].copy()
    wrong[:, 1] = random.permutation(wrong[:, 1])
    found = vote(structure, counts_of(scene), Correspondences({}, (wrong, *right[1:])))
    assert len(pairs_of(found) & pairs_of(true)) > 0.97 * len(true)


# The guided search


def slow_search(
    scene: SyntheticScene, structure: Structure, pose: RigidTransform, known: PointMatches, options: MatchOptions
) -> set[Pair]:
    """The same by loops over points and keypoints."""
    query, tracks = scene.query, structure.tracks
    points, keypoints, scores = [], [], []
    for p, x in enumerate(structure.x_in_world):
        projected = CAMERA.project(pose.inverse().apply(x))
        if p in known.point or not np.isfinite(projected).all():
            continue
        mine = np.flatnonzero(tracks.point == p)
        theirs = [
            scene.references[v].view.features.descriptors[k]
            for v, k in zip(tracks.view[mine], tracks.keypoint[mine], strict=True)
        ]
        for k, pixel in enumerate(query.features.keypoints):
            if k not in known.keypoint and np.linalg.norm(pixel - projected) <= options.radius_px:
                score = max(float(d @ query.features.descriptors[k]) for d in theirs)
                if score > options.min_similarity:
                    points.append(p)
                    keypoints.append(k)
                    scores.append(score)
    return {(p, k) for k, p in slow_one_to_one(keypoints, points, scores)}


@pytest.mark.parametrize("options", [PAPER_MATCH, MatchOptions(), MatchOptions(radius_px=60.0, min_similarity=0.2)])
@pytest.mark.parametrize("off_m", [0.0, 0.05])
def test_the_guided_search_equals_brute_force(options: MatchOptions, off_m: float) -> None:
    scene = make_scene(random_for("search"), SceneOptions(point_count=100, reference_count=3, distractor_count=60))
    structure, true = true_structure(scene)
    pose = about(scene.world_from_query, off_m, 0.2)
    some = PointMatches(true.point[:30], true.keypoint[:30], true.guided[:30], 0.0)
    for known in (NOTHING, some):
        found = search(scene.query, scene.references, structure, pose, known, options)
        assert_is_one_to_one(found)
        assert found.guided.all()
        assert found.radius_px == options.radius_px
        assert pairs_of(found) == slow_search(scene, structure, pose, known, options)
        assert not set(found.point) & set(known.point)
        assert not set(found.keypoint) & set(known.keypoint)


def test_the_guided_search_keeps_the_votes() -> None:
    scene = make_scene(random_for("adds"), SceneOptions(noise_px=0.3))
    structure, true = true_structure(scene)
    right = true_correspondences(scene).query_matches
    half = Correspondences({}, tuple(m[m[:, 0] % 2 == 0] for m in right))
    voted = vote(structure, counts_of(scene), half)
    found = match_points(scene.query, scene.references, structure, half, scene.world_from_query, MatchOptions())
    assert_is_one_to_one(found)
    assert pairs_of(voted) < pairs_of(found)
    np.testing.assert_array_equal(found.guided, np.arange(len(found)) >= len(voted))
    assert len(pairs_of(found) & pairs_of(true)) > 0.95 * len(true)
    assert len(pairs_of(found) - pairs_of(true)) < 0.01 * len(true)


def test_similarity_is_the_best_observations() -> None:
    """A point seen by two references, one of which shows it changed: the other is enough."""
    scene = make_scene(random_for("best"), SceneOptions(reference_count=2, descriptor_noise=0.0, seen_share=1.0))
    structure, true = true_structure(scene)
    last = scene.references[1]
    random = random_for("best descriptors")
    others = random.permutation(last.view.features.descriptors)
    changed = replace(last, view=replace(last.view, features=replace(last.view.features, descriptors=others)))
    references = (scene.references[0], changed)
    found = search(scene.query, references, structure, scene.world_from_query, NOTHING, MatchOptions(radius_px=5.0))
    assert len(pairs_of(found) & pairs_of(true)) > 0.95 * len(true)
