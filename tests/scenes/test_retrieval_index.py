"""The index of a scene: equal to a brute-force twin under any changes, and consistent for readers while it changes."""

import tempfile
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.scenes import random_for, unit_rows

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.scenes.retrieval import index as retrieval_index
from mapless_server.scenes.retrieval.index import SceneIndex
from mapless_server.scenes.retrieval.index_file import Identity, IndexFile
from mapless_server.scenes.retrieval.index_writer import Content, Making, unfinished, write_index
from mapless_server.scenes.retrieval.lists import ListOptions
from mapless_server.scenes.retrieval.narrowing import Narrowing, Sphere
from mapless_server.scenes.retrieval.ranking import Selection, rank_references
from mapless_server.store import IndexedReference, SceneChanges

DIMENSION = 24
SIMILARITY_TOLERANCE = 5e-3
"""Error of whole numbers of 8 bits, with as few numbers as here."""

POOL = unit_rows(random_for("index").standard_normal((64, DIMENSION))).astype(np.float32)
QUERY = POOL[0]


def pose(number: int) -> RigidTransform:
    return RigidTransform(rotation_from_vector([0.01 * number, 0.3, 0.0]), np.array([number, 2.0, -number]))


def reference(number: int, described: bool = True, name: str | None = None) -> IndexedReference:
    vector = POOL[number % len(POOL)] if described else None
    return IndexedReference(name or f"id-{number}", f"key-{number}", pose(number), vector)


def whole(*references: IndexedReference, generation: int = 1) -> SceneChanges:
    return SceneChanges(generation, references, frozenset(), True)


def change(
    generation: int, added: tuple[IndexedReference, ...] = (), removed: frozenset[str] = frozenset()
) -> SceneChanges:
    return SceneChanges(generation, added, removed, False)


@dataclass
class SlowIndex:
    """The same in words."""

    by_key: dict[str, IndexedReference] = field(default_factory=dict)

    def apply(self, changes: SceneChanges) -> None:
        if changes.is_whole:
            self.by_key = {}
        for key in changes.removed:
            self.by_key.pop(key, None)
        for it in changes.added:
            self.by_key[it.key] = it


def content(index: SceneIndex) -> dict[str, tuple[str, float | None, Array]]:
    """By key: id, similarity with the query, pose."""
    entries = index.entries()
    rows = entries.rows()
    found = {}
    for row, similarity in zip(rows.tolist(), entries.similarities(QUERY, rows).tolist(), strict=True):
        reference_id, key, world_from_camera = entries.reference(row)
        found[key] = (reference_id, None if np.isnan(similarity) else similarity, world_from_camera.matrix())
    assert len(found) == len(rows) == len(entries)
    return found


def assert_same(index: SceneIndex, slow: SlowIndex) -> None:
    found = content(index)
    assert found.keys() == slow.by_key.keys()
    for key, (reference_id, similarity, matrix) in found.items():
        expected = slow.by_key[key]
        assert reference_id == expected.reference_id
        assert reference_id in index.entries()
        np.testing.assert_array_equal(matrix, expected.world_from_camera.matrix())
        if expected.descriptor is None:
            assert similarity is None
        else:
            assert similarity == pytest.approx(float(expected.descriptor @ QUERY), abs=SIMILARITY_TOLERANCE)
    undescribed = {(it.reference_id, it.key) for it in slow.by_key.values() if it.descriptor is None}
    assert set(index.entries().undescribed()) == undescribed


STEPS = st.lists(
    st.tuples(
        st.lists(st.tuples(st.integers(0, 400), st.booleans()), max_size=30, unique_by=lambda it: it[0]),
        st.sets(st.integers(0, 400), max_size=60),
        st.integers(0, 9),
    ),
    max_size=12,
)


def filed(references: Iterable[IndexedReference], generation: int) -> SceneIndex:
    """An index whose file has these references."""
    identity = Identity("store", "scene", 1, "descriptor", DIMENSION)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / identity.file_name()
        making = Making(ListOptions(rows_per_list=4))
        with unfinished(path) as file:
            write_index(path, file, Content(identity, generation, "", [tuple(references)]), making)
        return SceneIndex(DIMENSION, IndexFile(path, identity))


@settings(deadline=None, max_examples=40)
@given(STEPS)
def test_any_changes_leave_what_they_leave_in_a_dictionary(
    steps: list[tuple[list[tuple[int, bool]], set[int], int]],
) -> None:
    """Adds (some without descriptor), removals (some of what never was), descriptors that come later, scenes anew.

    Now and then the scene is written to a file, and goes on from it.
    """
    index, slow = SceneIndex(DIMENSION), SlowIndex()
    gone: set[int] = set()
    for generation, (adds, removes, kind) in enumerate(steps):
        present = {int(key.removeprefix("key-")): it for key, it in slow.by_key.items()}
        fresh = tuple(reference(n, described) for n, described in adds if n not in present and n not in gone)
        late = tuple(reference(n) for n, it in present.items() if it.descriptor is None and n not in removes)
        added = fresh + (late if kind < 5 else ())
        changes = SceneChanges(generation, added, frozenset(f"key-{n}" for n in removes if n in present), kind == 0)
        gone |= removes | (set(present) if kind == 0 else set())
        index.apply(changes)
        slow.apply(changes)
        if kind == 9 and slow.by_key:
            index = filed(slow.by_key.values(), generation)
        assert index.generation == generation
        assert_same(index, slow)


@pytest.mark.parametrize("is_filed", [False, True])
def test_entries_stay_as_they_were(is_filed: bool) -> None:
    references = [reference(i, described=i > 0) for i in range(300)]
    index = SceneIndex(DIMENSION)
    index.apply(whole(*references))
    index = filed(references, 1) if is_filed else index
    before = index.entries()
    rows, similarities = before.rows(), before.similarities(QUERY, before.rows())
    index.describe({"key-0": POOL[5]})
    index.apply(change(2, (reference(1000, name="id-7"),), frozenset(f"key-{i}" for i in range(250))))
    np.testing.assert_array_equal(before.rows(), rows)
    np.testing.assert_array_equal(before.similarities(QUERY, rows), similarities)
    assert before.generation == 1
    assert before.undescribed() == [("id-0", "key-0")]
    assert before.reference(before.rows({"id-7"})[0])[1] == "key-7"
    now = index.entries()
    assert now.generation == 2
    assert "id-3" not in now
    assert now.reference(now.rows({"id-7"})[0])[1] == "key-1000"


def test_readers_see_one_generation_whole_during_changes() -> None:
    """Every generation has ten references, at x = generation; a search sees all of them or none."""
    index = SceneIndex(DIMENSION)
    torn: list[str] = []
    done = threading.Event()

    def references(generation: int) -> tuple[IndexedReference, ...]:
        at = RigidTransform(np.eye(3), np.array([generation, 0.0, 0.0]))
        vector = POOL[generation % len(POOL)]
        return tuple(IndexedReference(f"{i}", f"{generation}-{i}", at, vector) for i in range(10))

    def read() -> None:
        while not done.is_set():
            entries = index.entries()
            rows = entries.rows()
            expected = float(POOL[entries.generation % len(POOL)] @ QUERY)
            similar = np.allclose(entries.similarities(QUERY, rows), expected, atol=SIMILARITY_TOLERANCE)
            here = (entries.centres(rows)[:, 0] == entries.generation).all()
            if not (len(rows) == 10 and len(entries.rows([str(i) for i in range(10)])) == 10 and similar and here):
                torn.append(f"generation {entries.generation}: {len(rows)} rows")

    index.apply(whole(*references(0), generation=0))
    readers = [threading.Thread(target=read) for _ in range(3)]
    for reader in readers:
        reader.start()
    for generation in range(1, 600):
        index.apply(change(generation, references(generation), frozenset(f"{generation - 1}-{i}" for i in range(10))))
    done.set()
    for reader in readers:
        reader.join()
    assert not torn


def test_a_blank_photograph_resembles_nothing_and_is_described() -> None:
    index = SceneIndex(DIMENSION)
    blank = IndexedReference("blank", "blank", pose(1), np.zeros(DIMENSION, np.float32))
    index.apply(whole(blank, reference(0)))
    entries = index.entries()
    assert entries.similarities(QUERY, entries.rows()).tolist() == pytest.approx([0.0, 1.0], abs=SIMILARITY_TOLERANCE)
    assert entries.undescribed() == []


def test_a_descriptor_of_another_length_is_refused_unchanged() -> None:
    index = SceneIndex(DIMENSION)
    index.apply(whole(reference(0, described=False)))
    wrong = IndexedReference("b", "b", pose(1), np.ones(3, np.float32))
    with pytest.raises(ValueError, match=r"\(3,\)"):
        index.apply(change(2, (reference(5), wrong)))
    with pytest.raises(ValueError, match=r"\(3,\)"):
        index.describe({"key-0": np.ones(3, np.float32)})
    assert index.generation == 1
    assert index.entries().undescribed() == [("id-0", "key-0")]


def test_memory_follows_what_is_held() -> None:
    index = SceneIndex(512)
    vector = np.full(512, 512**-0.5, np.float32)
    many = tuple(IndexedReference(f"reference-{i:06d}", f"{i:032x}", pose(0), vector) for i in range(4000))
    index.apply(whole(*many))
    per_reference = index.size_bytes / len(many)
    assert 512 + 96 < per_reference < 512 + 600
    index.apply(change(2, removed=frozenset(it.key for it in many[:-10])))
    assert index.size_bytes < 0.1 * per_reference * len(many)


class TestFiles:
    """An index with a file, compared with one without."""

    @staticmethod
    def places(count: int) -> tuple[list[IndexedReference], list[NDArray[np.float32]]]:
        """References at 40 places, and photographs taken there."""
        random = random_for("places")
        centres = random.standard_normal((40, DIMENSION))
        views = unit_rows(centres[np.arange(count) % 40] + 0.4 * random.standard_normal((count, DIMENSION)))
        queries = unit_rows(centres + 0.4 * random.standard_normal((40, DIMENSION)))
        references = [
            IndexedReference(f"id-{i}", f"key-{i}", pose(i), view) for i, view in enumerate(views.astype(np.float32))
        ]
        return references, [*queries.astype(np.float32)]

    def test_of_a_small_scene_ranks_as_memory_does(self) -> None:
        references, queries = self.places(400)
        in_memory, in_file = SceneIndex(DIMENSION), filed(references[:300], 1)
        in_memory.apply(whole(*references[:300]))
        later = change(2, tuple(references[300:]), frozenset(f"key-{i}" for i in range(0, 300, 7)))
        for index in (in_memory, in_file):
            index.apply(later)
        near = Narrowing(position=Sphere(np.array([200.0, 2.0, -200.0]), 40.0))
        named = [f"id-{i}" for i in range(100, 350)]
        for query in queries:
            for selection in (Selection(10), Selection(10, near), Selection(10, among=named)):
                expected, found = (rank_references(it.entries(), query, selection) for it in (in_memory, in_file))
                assert [(it.reference_id, it.key) for it in found] == [(it.reference_id, it.key) for it in expected]
                assert [it.similarity for it in found] == pytest.approx([it.similarity for it in expected], abs=1.01e-4)

    def test_of_a_large_one_finds_what_all_comparisons_find(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(retrieval_index, "CONSIDERED", 300)
        references, queries = self.places(4000)
        entries = filed(references, 1).entries()
        rows = entries.rows()
        right = 0
        for query in queries:
            exact, similar = entries.similarities(query, rows), entries.similar(query, rows, 10)
            assert 300 <= len(similar.rows) < 800
            np.testing.assert_allclose(similar.similarity, exact[similar.rows], atol=1e-6)
            assert similar.typical == pytest.approx(float(np.median(exact)), abs=0.1)
            right += len({*rows[np.argsort(-exact)[:10]]} & {*similar.rows[np.argsort(-similar.similarity)[:10]]})
        assert right >= 0.97 * 10 * len(queries)
