"""How scenes age, as metrics say it."""

import asyncio
from dataclasses import replace
from pathlib import Path

import pytest
from support.stores import make_reference

from mapless import Accuracy, AdoptionPolicy, Provenance, Voucher
from mapless_server.observability.scraped import SceneAge, Scraped
from mapless_server.security import SceneKey
from mapless_server.serve import aging
from mapless_server.serve.aging import ages, watch_scenes
from mapless_server.store import RetirementReason, SceneAttributes, Store, adoption, counts
from mapless_server.store.counts import DAY_US, LOCALIZED, CountKey, Sums
from mapless_server.store.records import Standing
from mapless_server.store.rows import now_us

HALL = SceneKey("acme/hall")


def test_a_scene_that_ages_has_metrics(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        store.create_scene(HALL, SceneAttributes(adoption=AdoptionPolicy(min_surveyed_share=0.4)))
        keys = {it.reference_id: it.key for it in store.add_references(HALL, [make_reference(it) for it in "abc"])}
        known = Provenance("ADOPTED", Accuracy(0.01, 0.02, 0.1, 0.2), 0.5, (Voucher("a", 40),))
        for name in ("x", "y"):
            new = replace(make_reference(name), provenance=known, place_key=keys["a"])
            adoption.adopt(store, HALL, new, [keys["a"]], 9)
        adoption.retire(store, HALL, [keys["c"]], RetirementReason.CONTRADICTED)
        known_of = {
            keys["a"]: adoption.outdated(Standing(surveyed_share=0.35, photograph_count=20)),
            keys["b"]: Standing(surveyed_share=0.7, photograph_count=20),
        }
        adoption.change_standings(store.database, known_of, lambda key, _: known_of[key])
        today = now_us() // DAY_US
        planted = {
            CountKey(today, "p", LOCALIZED): Sums(photograph_count=6),
            CountKey(today - 6, "p", "gate"): Sums(photograph_count=2),
            CountKey(today - 7, "p", "gate"): Sums(photograph_count=1),
            CountKey(today - 13, "p", LOCALIZED): Sums(photograph_count=9),
            CountKey(today - 14, "p", "gate"): Sums(photograph_count=90),
        }
        counts.add_counts(store.database, {HALL: planted})
        assert ages(store, 5) == [SceneAge(HALL, 8, 0.75, 0.9, 0.35, 1, 2, 1)]
        assert ages(store, 0) == []
        store.delete_scene(HALL)
        assert ages(store, 5) == []


def test_what_fails_once_is_looked_up_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever fails; meanwhile metrics say nothing."""
    looked, scraped = list[int](), Scraped()
    age = SceneAge(HALL, 8, 0.75, 0.9, 0.35, 1, 2, 1)

    def look(_: Store, most: int) -> list[SceneAge]:
        looked.append(len(scraped.scenes))
        if len(looked) == 2:
            raise ZeroDivisionError
        return [age]

    async def watched(store: Store) -> None:
        watching = asyncio.ensure_future(watch_scenes(store, 1, scraped))
        while len(looked) < 4:
            await asyncio.sleep(0.002)
            assert not watching.done()
        watching.cancel()

    monkeypatch.setattr(aging, "ages", look)
    monkeypatch.setattr(aging, "FIRST_S", 0.001)
    monkeypatch.setattr(aging, "AGAIN_S", 0.001)
    with Store.open(tmp_path) as store:
        asyncio.run(watched(store))
    assert looked[:4] == [0, 1, 0, 1]
