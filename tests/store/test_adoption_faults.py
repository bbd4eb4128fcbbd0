"""Adopting where something is in the way: another server, a writer's reference, a full disk, a kill, a backup."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from support.adopted import HALL, adopt, adopted, hall
from support.stores import Place, Shared, make_reference

from mapless_server.errors import AlreadyExists, Overloaded
from mapless_server.store import ReferenceRecord, Store, adoption
from mapless_server.store.backup import back_up, restore


def test_of_servers_at_once_one_has_the_last_slot(place: Place) -> None:
    """Each adopts another photograph; who is second finds the place full."""
    with place.open() as store:
        hall(store)
        servers = [store.uncached() for _ in range(4)]

        def adopt_one(number: int) -> ReferenceRecord | None:
            try:
                return adopt(servers[number], adopted(f"new-{number}"), 1)[0]
            except adoption.PlaceFull:
                return None

        with ThreadPoolExecutor(len(servers)) as pool:
            made = [it for it in pool.map(adopt_one, range(len(servers))) if it is not None]
        assert [it.reference_id for it in adoption.list_adopted(store.database, HALL)] == [made[0].reference_id]
        assert (len(made), store.get_scene(HALL).reference_count) == (1, 3)


def test_servers_that_learn_at_once_do_not_block_each_other(shared: Shared) -> None:
    """Each has the references in another order of usefulness."""
    with shared.open() as store:
        hall(store)
        keys = [adopt(store, adopted(f"new-{number}"), 99)[0].key for number in range(6)]
        servers = [store.uncached() for _ in range(2)]

        def learn(number: int) -> None:
            for turn in range(10):
                ordered = keys if (turn + number) % 2 else keys[::-1]
                adoption.set_usefulness(servers[number].database, dict.fromkeys(ordered, 0.1 * number))

        with ThreadPoolExecutor(len(servers)) as pool:
            list(pool.map(learn, range(len(servers))))
        assert len({it.usefulness for it in adoption.list_adopted(store.database, HALL)}) == 1


def test_a_writers_reference_keeps_the_id_of_a_photograph(place: Place) -> None:
    with place.open() as store:
        hall(store)
        (own,) = store.add_references(HALL, [make_reference("adopted-0")])
        with pytest.raises(AlreadyExists):
            adopt(store, adopted("adopted-0"), 9)
        assert store.get_reference(HALL, "adopted-0").key == own.key
        assert adoption.list_adopted(store.database, HALL) == []


def test_a_full_disk_adopts_nothing_and_keeps_what_was_adopted(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        hall(store)
        first = adopt(store, adopted("x", 0.1), 1)[0]
        with store.database.read() as connection:
            pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
            connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")
        with pytest.raises(Overloaded) as caught:
            adopt(store, replace(adopted("y", 0.9), image=bytes(2**20)), 1)
        assert caught.value.reason == "STORE_FULL"
        assert [it.key for it in adoption.list_adopted(store.database, HALL)] == [first.key]


KILLED = """
import os, sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from support.adopted import HALL, adopt, adopted
from mapless_server.store import Store, adoption, changes
changes.note_removals = lambda *_: os._exit(9)  # after the least useful one was deleted
adopt(Store.open(Path(sys.argv[1])), adopted("y", 0.9), 1)
"""


def test_a_server_killed_while_it_adopts_has_changed_nothing(tmp_path: Path) -> None:
    with Store.open(tmp_path) as store:
        hall(store)
        adopt(store, adopted("x", 0.1), 1)
    child = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), *sys.path], check=False)
    assert child.returncode == 9
    with Store.open(tmp_path) as store:
        assert [it.reference_id for it in adoption.list_adopted(store.database, HALL)] == ["x"]
        assert store.get_scene(HALL).reference_count == 3
        adopt(store, adopted("y", 0.9), 1)


def test_a_restored_backup_has_what_vouches_for_adopted_ones(tmp_path: Path) -> None:
    with Store.open(tmp_path / "first") as store:
        at_a = hall(store)["a"]
        adopt(store, adopted("x"), 9)
        known = store.get_reference(HALL, "x").provenance
        back_up(store.database, tmp_path / "backup")
    with Store.open(tmp_path / "second") as store:
        restore(tmp_path / "backup", store.database)
        assert adoption.unvouched(store.database, HALL) == []
        assert store.get_reference(HALL, "x").provenance == known
        assert [it.place_key for it in adoption.list_adopted(store.database, HALL)] == [at_a]
