"""Pairs of matchings: those that no server has used for long are deleted, no others, on either database."""

from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from support.stores import Place, make_reference

from mapless_server.security import SceneKey
from mapless_server.store import Store, pairs, rows
from mapless_server.store.pairs import KEPT_S, PairStore, Progress, delete_unused, record_use

SCENE = SceneKey("office")
OURS, THEIRS = "aliked/strict", "sift/strict"


@pytest.fixture
def store(place: Place, monkeypatch: pytest.MonkeyPatch) -> Iterator[Store]:
    """Every pair of three references, matched in two ways, both used now."""
    monkeypatch.setattr(pairs, "_REFERENCES_AT_A_TIME", 2)
    with place.open() as store:
        store.create_scene(SCENE)
        store.add_references(SCENE, [make_reference(name, seed) for seed, name in enumerate("abc")])
        for name in (OURS, THEIRS):
            match_all(store, name)
        record_use(store.database, [OURS, THEIRS])
        yield store


def match_all(store: Store, name: str) -> int:
    """Number of pairs that are stored."""
    pairs, progress, count = PairStore(store.database), Progress(), 0
    keys = list(store.find_keys(SCENE, ["a", "b", "c"]).values())
    while claim := pairs.claim(name, progress):
        made = {(other, claim.key): np.zeros((1, 2), np.int32) for other in pairs.list_missing(name, claim, keys, 9)}
        pairs.add(name, claim, made, is_complete=True)
        count += len(made)
    return count


def count_pairs(place: Place) -> Counter[str]:
    return Counter(name for (name,) in place.fetch("SELECT matching FROM reference_pair"))


def let_pass(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    now_us = rows.now_us
    monkeypatch.setattr(rows, "now_us", lambda: now_us() + round(seconds * 1e6))


def nothing() -> None:
    pass


def test_what_is_used_by_any_server_is_kept(store: Store, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    let_pass(monkeypatch, KEPT_S - 1)
    delete_unused(store.database, nothing)
    assert count_pairs(place) == {OURS: 3, THEIRS: 3}
    record_use(store.database, [OURS])
    let_pass(monkeypatch, 2)
    delete_unused(store.database, nothing)
    assert count_pairs(place) == {OURS: 3}
    assert place.fetch("SELECT matching FROM matching_use") == [(OURS,)]


@pytest.fixture
def unused(store: Store, monkeypatch: pytest.MonkeyPatch) -> Store:
    """The store when only one of the two ways has been used of late."""
    let_pass(monkeypatch, KEPT_S + 1)
    record_use(store.database, [OURS])
    return store


def test_deleted_pairs_are_made_again(unused: Store, place: Place) -> None:
    delete_unused(unused.database, nothing)
    record_use(unused.database, [THEIRS])
    assert match_all(unused, OURS) == 0
    assert match_all(unused, THEIRS) == 3
    assert count_pairs(place) == {OURS: 3, THEIRS: 3}


def test_a_server_that_comes_back_meanwhile_stops_it(unused: Store, place: Place) -> None:
    calls = list[None]()

    def second_portion() -> None:
        calls.append(None)
        if len(calls) == 2:
            record_use(unused.database, [THEIRS])

    delete_unused(unused.database, second_portion)
    assert len(calls) == 2
    assert place.fetch("SELECT count(*) FROM reference_matching WHERE matching = ?", THEIRS) == [(1,)]
    assert match_all(unused, THEIRS) > 0


def test_a_deletion_that_was_interrupted_is_completed(unused: Store, place: Place) -> None:
    calls = list[None]()

    def end() -> None:
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        delete_unused(unused.database, end)
    assert place.fetch("SELECT count(*) FROM reference_matching WHERE matching = ?", THEIRS) == [(1,)]
    delete_unused(unused.database, nothing)
    assert place.fetch("SELECT count(*) FROM reference_matching WHERE matching = ?", THEIRS) == [(0,)]
    assert count_pairs(place) == {OURS: 3}
