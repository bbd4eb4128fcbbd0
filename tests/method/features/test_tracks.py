"""Tracks: planted chains, conflicts, and a comparison with a slow union-find."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mapless_server.method.features.tracks import Tracks, build_tracks
from mapless_server.method.features.views import Matches

Pairs = Mapping[tuple[int, int], Matches]
Track = frozenset[tuple[int, int]]
"""A track's observations (view, keypoint)."""


def pairs_of(matches: Mapping[tuple[int, int], Sequence[tuple[int, int]]]) -> Pairs:
    return {pair: np.array(m, np.int32).reshape(-1, 2) for pair, m in matches.items()}


def as_sets(tracks: Tracks) -> set[Track]:
    """The sets of keypoints, without the numbers of the points."""
    seen = defaultdict(set)
    for point, view, keypoint in zip(
        tracks.point.tolist(), tracks.view.tolist(), tracks.keypoint.tolist(), strict=True
    ):
        seen[point].add((view, keypoint))
    return {frozenset(s) for s in seen.values()}


def assert_is_well_formed(tracks: Tracks) -> None:
    assert len(tracks.point) == len(tracks.view) == len(tracks.keypoint)
    order = np.lexsort((tracks.view, tracks.point))
    np.testing.assert_array_equal(order, np.arange(len(order)))
    np.testing.assert_array_equal(np.unique(tracks.point), np.arange(tracks.point_count))
    np.testing.assert_array_equal(tracks.point[tracks.starts], np.arange(tracks.point_count))
    seen_in = np.stack([tracks.point, tracks.view], axis=1)
    assert len(np.unique(seen_in, axis=0)) == len(seen_in)
    assert (np.bincount(tracks.point) >= 2).all()


def slow_tracks(pairs: Pairs, anchor: int | None) -> list[tuple[Track, Mapping[tuple[int, int], int]]]:
    """The connected keypoints by union-find, and how many matches each has; conflicts not yet resolved."""
    parent: dict[tuple[int, int], tuple[int, int]] = {}
    degree: dict[tuple[int, int], int] = defaultdict(int)

    def root(node: tuple[int, int]) -> tuple[int, int]:
        while parent.setdefault(node, node) != node:
            node = parent[node]
        return node

    for (i, j), matches in pairs.items():
        if anchor is None or anchor in (i, j):
            for a, b in matches.tolist():
                degree[i, a] += 1
                degree[j, b] += 1
                parent[root((i, a))] = root((j, b))
    groups = defaultdict(set)
    for node in list(parent):
        groups[root(node)].add(node)
    return [(frozenset(group), degree) for group in groups.values()]


@st.composite
def random_pairs(draw: st.DrawFn) -> tuple[Pairs, list[int]]:
    """One-to-one matches among up to five views with up to six keypoints each, many of them in conflict."""
    counts = draw(st.lists(st.integers(0, 6), min_size=2, max_size=5))
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for j in range(len(counts)):
        for i in range(j):
            size = draw(st.integers(0, min(counts[i], counts[j])))
            first = draw(st.permutations(range(counts[i])))[:size]
            second = draw(st.permutations(range(counts[j])))[:size]
            pairs[i, j] = list(zip(first, second, strict=True))
    return pairs_of(pairs), counts


@settings(max_examples=40)
@given(random_pairs(), st.sampled_from([None, 0, 1]))
def test_tracks_equal_those_of_a_union_find(drawn: tuple[Pairs, list[int]], anchor: int | None) -> None:
    pairs, counts = drawn
    tracks = build_tracks(pairs, counts, anchor)
    assert_is_well_formed(tracks)
    groups = [(g, degree) for g, degree in slow_tracks(pairs, anchor) if len({view for view, _ in g}) >= 2]
    actual = as_sets(tracks)
    assert len(actual) == len(groups)
    for group, degree in groups:
        (track,) = [t for t in actual if t <= group]
        assert {view for view, _ in track} == {view for view, _ in group}
        for view, keypoint in track:
            assert degree[view, keypoint] == max(degree[node] for node in group if node[0] == view)


@settings(max_examples=40)
@given(random_pairs(), st.randoms(use_true_random=False))
def test_the_order_of_pairs_does_not_change_the_tracks(drawn: tuple[Pairs, list[int]], shuffler: object) -> None:
    pairs, counts = drawn
    keys = sorted(pairs, key=lambda _: shuffler.random())  # type: ignore[attr-defined]
    shuffled = {key: pairs[key][::-1] for key in keys}
    expected, actual = build_tracks(pairs, counts), build_tracks(shuffled, counts)
    for name in ("point", "view", "keypoint"):
        np.testing.assert_array_equal(getattr(actual, name), getattr(expected, name))


@settings(max_examples=40)
@given(random_pairs(), st.data())
def test_select_keeps_the_chosen_and_renumbers(drawn: tuple[Pairs, list[int]], data: st.DataObject) -> None:
    tracks = build_tracks(*drawn)
    chosen = np.array([data.draw(st.booleans()) for _ in range(tracks.point_count)], bool)
    selected = tracks.select(chosen)
    assert_is_well_formed(selected)
    for new, old in enumerate(np.flatnonzero(chosen)):
        for name in ("view", "keypoint"):
            of_new = getattr(selected, name)[selected.point == new]
            np.testing.assert_array_equal(of_new, getattr(tracks, name)[tracks.point == old])


@settings(max_examples=40)
@given(random_pairs(), st.data())
def test_prune_drops_observations_and_single_leftovers(drawn: tuple[Pairs, list[int]], data: st.DataObject) -> None:
    tracks = build_tracks(*drawn)
    good = np.array([data.draw(st.booleans()) for _ in tracks.point], bool)
    pruned, rows, kept = tracks.prune(good)
    assert_is_well_formed(pruned)
    assert kept.shape == (tracks.point_count,)
    assert rows.shape == tracks.point.shape
    np.testing.assert_array_equal(tracks.keypoint[rows], pruned.keypoint)
    assert pruned.point_count == kept.sum()
    for new, old in enumerate(np.flatnonzero(kept)):
        np.testing.assert_array_equal(
            pruned.keypoint[pruned.point == new], tracks.keypoint[(tracks.point == old) & good]
        )
    for old in np.flatnonzero(~kept):
        assert good[tracks.point == old].sum() < 2
