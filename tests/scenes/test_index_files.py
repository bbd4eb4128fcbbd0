"""Files of large scenes: searched as the store's scene is now, made again where they are not certainly of it."""

import errno
import logging
import os
import shutil
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.disks import small_disk
from support.images import encode, textured
from support.scenes import random_for, unit_rows
from support.servers import CAMERA, StandInDescriptor, StandInExtractor, pose
from support.stores import damage
from support.waiting import wait_until

from mapless_server.errors import NotFound
from mapless_server.method.options import StageContext
from mapless_server.scenes import index_files
from mapless_server.scenes.index_files import IndexFileOptions, IndexFiles, again_if_damaged
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.scenes.retrieval import index_writer
from mapless_server.scenes.retrieval.index import Entries
from mapless_server.scenes.retrieval.index_file import BLOCK_ROWS, VERSION, Header, IndexFile
from mapless_server.scenes.retrieval.lists import ListOptions
from mapless_server.scenes.retrieval.ranking import Selection, rank_references
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store, restoring
from mapless_server.store.adoption import retire
from mapless_server.store.portions import IndexedPortion, IndexReader
from mapless_server.store.records import RetirementReason

SCENE = SceneKey("s")
EXTRACTOR, DESCRIPTOR = StandInExtractor(), StandInDescriptor()
OPTIONS = IndexFileOptions(least_references=40, least_changed=1000, retry_s=0.0, lists=ListOptions(rows_per_list=8))
IMAGE = textured(seed=1)
VIEW, FILE = EXTRACTOR.extract(IMAGE, CAMERA), encode(".png", IMAGE)
VECTORS = unit_rows(random_for("index files").standard_normal((200, DESCRIPTOR.dimension))).astype(np.float32)
PARTS = (
    *("means", "starts", "norms", "rows", "checks", "viewpoints", "id_hashes", "id_rows", "key_hashes", "key_rows"),
    *("places", "records", "damaged", "header"),
)


def new(i: int, is_described: bool = True) -> NewReference:
    descriptors = {DESCRIPTOR.name: VECTORS[i]} if is_described else {}
    return NewReference(f"r{i}", FILE, CAMERA, pose(float(i)), {EXTRACTOR.name: VIEW}, descriptors)


class Indexes:
    """A server's indexes of a store, with files in a folder."""

    def __init__(self, store: Store, folder: Path, options: IndexFileOptions = OPTIONS) -> None:
        self.files = IndexFiles(store, DESCRIPTOR, folder, options=options)
        self.of_scenes = SceneIndexes(store, ReferenceLibrary(store), DESCRIPTOR, EXTRACTOR, 2**30, self.files)

    def entries(self) -> Entries:
        return self.of_scenes.entries(SCENE, StageContext())

    def filed(self) -> Entries:
        """The entries, once they are of a file."""
        wait_until(lambda: self.entries().file is not None)
        return self.entries()

    def found(self) -> list[list[tuple[str, str]]]:
        """The references that all photographs find, and every reference by its id and key."""

        def find() -> list[list[tuple[str, str]]]:
            entries = self.entries()
            named = entries.rows([f"r{i}" for i in range(200)])
            keys = [entries.reference(row)[1] for row in named.tolist()]
            assert list(entries.rows_of_keys(keys).values()) == named.tolist()
            ranked = [rank_references(entries, vector, Selection(5)) for vector in VECTORS[::9]]
            return [[(it.reference_id, it.key) for it in some] for some in ranked]

        return again_if_damaged(find)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as store:
        store.create_scene(SCENE)
        store.add_references(SCENE, [new(i) for i in range(60)])
        yield store


@pytest.fixture
def serve(store: Store, tmp_path: Path) -> Iterator[Callable[..., Indexes]]:
    """Starts servers on the store, with files in one folder unless another one is given."""
    started: list[Indexes] = []

    def serve(folder: Path = tmp_path / "indexes", options: IndexFileOptions = OPTIONS) -> Indexes:
        started.append(Indexes(store, folder, options))
        return started[-1]

    yield serve
    for it in started:
        it.of_scenes.close()


def file_in(folder: Path) -> Path:
    (path,) = folder.glob("*.index")
    return path


Serve = Callable[..., Indexes]


class TestUse:
    def test_a_start_opens_the_file_and_reads_what_changed(
        self, serve: Serve, store: Store, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        serve().filed()
        store.add_references(SCENE, [new(i) for i in range(60, 63)])
        store.delete_reference(SCENE, "r5")
        monkeypatch.setattr(IndexReader, "read_portion", None)
        indexes = serve()
        entries = indexes.entries()
        assert entries.file is not None
        assert len(entries) == 62
        assert indexes.found() == serve(options=replace(OPTIONS, least_references=1000)).found()
        assert indexes.of_scenes.filed == [entries.file.path.stat().st_size]

    def test_changes_are_found_at_once_deleted_ones_never(self, serve: Serve, store: Store) -> None:
        indexes = serve()
        indexes.filed()
        for i in range(60, 80):
            store.add_references(SCENE, [new(i)])
            store.delete_reference(SCENE, f"r{i - 60}")
            ranked = rank_references(indexes.entries(), VECTORS[i], Selection(60))
            assert ranked[0].reference_id == f"r{i}"
            assert f"r{i - 60}" not in {it.reference_id for it in ranked}
        assert indexes.entries().file is not None

    def test_a_retired_one_is_not_found_until_it_is_restored(self, serve: Serve, store: Store) -> None:
        indexes = serve()
        indexes.filed()
        retire(store, SCENE, [store.get_reference(SCENE, "r7").key], RetirementReason.CONTRADICTED)
        for it in (indexes, serve()):
            entries = it.entries()
            assert entries.file is not None
            assert "r7" not in entries
        made = serve(options=replace(OPTIONS, longest_kept_s=0.0))
        wait_until(lambda: made.entries().changed_counts() == (0, 0))
        assert len(made.filed()) == 59
        restoring.restore_reference(store, SCENE, "r7")
        for it in (indexes, made, serve()):
            assert "r7" in it.entries()
            assert len(it.entries()) == 60

    def test_a_deleted_and_added_one_is_the_new_one(self, serve: Serve, store: Store) -> None:
        indexes = serve()
        before = indexes.filed()
        store.delete_reference(SCENE, "r7")
        (record,) = store.add_references(SCENE, [replace(new(7), descriptors={DESCRIPTOR.name: VECTORS[100]})])
        entries = indexes.entries()
        assert entries.reference(int(entries.rows(["r7"])[0]))[1] == record.key
        assert before.reference(int(before.rows(["r7"])[0]))[1] != record.key

    def test_it_is_made_again_after_many_changes(self, serve: Serve, store: Store) -> None:
        indexes = serve(options=replace(OPTIONS, least_changed=3, changed_share=0.01))
        indexes.filed()
        store.add_references(SCENE, [new(i) for i in range(60, 64)])
        wait_until(lambda: indexes.entries().changed_counts() == (0, 0))
        assert len(indexes.entries()) == 64

    def test_a_deleted_reference_does_not_stay_in_it(self, serve: Serve, store: Store, tmp_path: Path) -> None:
        indexes = serve(options=replace(OPTIONS, longest_kept_s=0.0))
        key = f"r0{store.get_reference(SCENE, 'r0').key}".encode()
        indexes.filed()
        assert key in file_in(tmp_path / "indexes").read_bytes()
        store.delete_reference(SCENE, "r0")
        wait_until(lambda: indexes.entries() and key not in file_in(tmp_path / "indexes").read_bytes())

    def test_what_lacks_a_descriptor_is_described_in_memory(self, serve: Serve, store: Store) -> None:
        store.add_references(SCENE, [new(60, is_described=False)])
        indexes = serve()
        indexes.of_scenes.entries(SCENE, StageContext(), waits=False)
        wait_until(lambda: indexes.of_scenes.entries(SCENE, StageContext(), waits=False).file is not None)
        assert indexes.of_scenes.entries(SCENE, StageContext(), waits=False).undescribed() == [
            ("r60", store.get_reference(SCENE, "r60").key)
        ]
        assert indexes.entries().undescribed() == []
        assert len(indexes.entries()) == 61

    def test_a_small_scene_has_none(self, serve: Serve, tmp_path: Path) -> None:
        indexes = serve(options=replace(OPTIONS, least_references=61))
        assert indexes.entries().file is None
        indexes.of_scenes.close()
        assert not (tmp_path / "indexes").exists()

    def test_it_is_deleted_with_its_scene(self, serve: Serve, store: Store, tmp_path: Path) -> None:
        one, other = serve(), serve(tmp_path / "other")
        for it in (one, other):
            it.filed()
        store.delete_scene(SCENE)
        one.of_scenes.forget(SCENE)
        assert not [*(tmp_path / "indexes").glob("*")]
        other.of_scenes.close()
        store.create_scene(SceneKey("t"))
        store.add_references(SceneKey("t"), [new(i) for i in range(60)])
        restarted = serve(tmp_path / "other")
        restarted.of_scenes.entries(SceneKey("t"), StageContext())
        wait_until(lambda: restarted.of_scenes.entries(SceneKey("t"), StageContext()).file is not None)
        assert file_in(tmp_path / "other").name == restarted.files._path(SceneKey("t")).name

    def test_it_is_deleted_where_another_server_deletes_the_scene(
        self, serve: Serve, store: Store, tmp_path: Path
    ) -> None:
        server = serve()
        server.filed()
        store.delete_scene(SCENE)
        with pytest.raises(NotFound):
            server.entries()
        assert not list(tmp_path.rglob("*.index"))

    def test_it_is_deleted_if_the_scene_is_while_it_is_made(
        self, serve: Serve, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made = threading.Event()

        def written(*given: Any) -> None:
            index_writer.write_index(*given)
            store.delete_scene(SCENE)
            made.set()

        monkeypatch.setattr(index_files, "write_index", written)
        serve().entries()
        assert made.wait(30)
        wait_until(lambda: not list(tmp_path.rglob("*.index")))

    def test_what_a_killed_process_has_left_is_deleted(self, serve: Serve, tmp_path: Path) -> None:
        server = serve()
        server.filed()
        left = next(tmp_path.rglob("*.index")).with_name("0123.part")
        left.write_bytes(b"some rows")
        server.files._delete_abandoned()
        assert not left.exists()
        server.filed()

    def test_a_damaged_reference_is_as_damaged_as_in_memory(self, serve: Serve, store: Store) -> None:
        damage(store, SCENE, "r9", "descriptor")
        serve().filed()
        indexes = serve()
        assert "r9" not in indexes.filed()
        assert [indexes.of_scenes.is_damaged(SCENE, it) for it in ("r8", "r9")] == [False, True]

    def test_reading_a_scene_without_one_goes_on_when_a_call_ends(
        self, serve: Serve, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        read, go_on, begun = IndexReader.read_portion, threading.Event(), list[str]()

        def read_slowly(self: IndexReader, scene_key: SceneKey, after_id: str, **more: Any) -> IndexedPortion:
            if not after_id:
                begun.append(scene_key)
            go_on.wait()
            return read(self, scene_key, after_id, **more)

        def is_cancelled() -> None:
            if begun:
                raise TimeoutError("cancelled")

        monkeypatch.setattr(IndexReader, "read_portion", read_slowly)
        indexes = serve()
        for _ in range(2):
            with pytest.raises(TimeoutError, match="cancelled"):
                indexes.of_scenes.entries(SCENE, StageContext(is_cancelled))
        assert begun == [SCENE]
        go_on.set()
        assert len(indexes.entries()) == 60
        assert len(indexes.filed()) == 60
        assert begun == [SCENE] * 2


class TestDistrust:
    @pytest.mark.parametrize("part", PARTS)
    def test_a_changed_byte_anywhere_is_found(self, serve: Serve, store: Store, tmp_path: Path, part: str) -> None:
        """While a server uses the file, and before it starts; either way it answers, and makes the file again."""
        damage(store, SCENE, "r9", "descriptor")  # so that every part has bytes
        indexes = serve()
        indexes.filed()
        path, expected = file_in(tmp_path / "indexes"), indexes.found()
        right = path.read_bytes()
        with path.open("rb") as file:
            of_parts = Header.read(file.fileno()).parts
        offset = 40 if part == "header" else of_parts[part].offset + of_parts[part].size // 2
        wrong = right[:offset] + bytes([right[offset] ^ 4]) + right[offset + 1 :]
        path.write_bytes(wrong)
        running = indexes if part in ("rows", "records") else serve()
        assert running.found() == expected
        assert running.found() == expected
        running.filed()
        assert path.read_bytes() == right

    def test_one_that_cannot_be_deleted_is_not_opened_again(
        self, serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refuse(*_: object, **__: object) -> None:
            raise OSError(errno.EROFS, "Read-only file system")

        indexes = serve()
        indexes.filed()
        path, expected = file_in(tmp_path / "indexes"), indexes.found()
        path.write_bytes(path.read_bytes()[:-1])
        restarted = serve(options=replace(OPTIONS, retry_s=3600.0))
        monkeypatch.setattr(Path, "unlink", refuse)
        monkeypatch.setattr(index_files, "unfinished", refuse)
        assert restarted.found() == expected
        restarted.of_scenes._cached.forget(lambda *_: True)
        monkeypatch.setattr(IndexFile, "__init__", refuse)
        assert restarted.found() == expected
        monkeypatch.undo()

    @pytest.mark.parametrize("wrong", [b"", b"mapless", "half", "version", "longer"])
    def test_what_is_no_whole_file_of_this_version_is_not_used(
        self, serve: Serve, tmp_path: Path, wrong: bytes | str
    ) -> None:
        indexes = serve()
        indexes.filed()
        path, expected = file_in(tmp_path / "indexes"), indexes.found()
        right = path.read_bytes()
        variants = {
            "half": right[: len(right) // 2],
            "version": right[:17].ljust(20, b"\0") + (VERSION + 1).to_bytes(4, sys.byteorder) + right[24:],
            "longer": right + b"\0",
        }
        path.write_bytes(wrong if isinstance(wrong, bytes) else variants[wrong])
        restarted = serve()
        assert restarted.entries().file is None
        assert restarted.found() == expected
        restarted.filed()
        assert path.read_bytes() == right

    def test_that_of_a_scene_created_again_is_not_used(self, serve: Serve, store: Store) -> None:
        indexes = serve()
        indexes.filed()
        store.delete_scene(SCENE)
        store.create_scene(SCENE)
        store.add_references(SCENE, [new(i) for i in range(100, 150)])
        for it in (indexes, serve()):
            ranked = rank_references(it.entries(), VECTORS[3], Selection(60))
            assert {it.reference_id for it in ranked} == {f"r{i}" for i in range(100, 150)}

    @pytest.mark.parametrize("is_added", [True, False])
    def test_that_of_another_history_is_not_used(self, serve: Serve, tmp_path: Path, is_added: bool) -> None:
        """A backup is restored, and changed until the scene has the generation and the size that it had."""
        with Store.open(tmp_path / "a") as store:
            store.create_scene(SCENE)
            store.add_references(SCENE, [new(i) for i in range(60)])
        shutil.copytree(tmp_path / "a", tmp_path / "backup")
        found = []
        for i in (70, 80):
            with Store.open(tmp_path / "a") as store:
                if is_added:
                    store.add_references(SCENE, [new(i)])
                else:
                    store.delete_reference(SCENE, f"r{i - 50}")
                indexes = Indexes(store, tmp_path / "indexes")
                found.append((indexes.entries().file, indexes.found()))
                expected = Indexes(store, tmp_path / "none", replace(OPTIONS, least_references=1000)).found()
                assert found[-1][1] == expected
                indexes.filed()
                indexes.of_scenes.close()
            shutil.rmtree(tmp_path / "a")
            shutil.copytree(tmp_path / "backup", tmp_path / "a")
        assert found[1][0] is None

    def test_damage_is_logged_once_and_names_the_scene(
        self, serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        indexes = serve()
        indexes.filed()
        path = file_in(tmp_path / "indexes")
        data = bytearray(path.read_bytes())
        with path.open("rb") as file:
            rows = Header.read(file.fileno()).parts["rows"]
        data[rows.offset : rows.offset + rows.size] = bytes(rows.size)
        path.write_bytes(data)
        with caplog.at_level(logging.ERROR):
            indexes.found()
        assert [it.getMessage() for it in caplog.records] == ["the index file of scene s is damaged, and is made again"]


class TestMaking:
    def test_a_killed_process_leaves_nothing_that_is_used(self, serve: Serve, tmp_path: Path) -> None:
        folder = tmp_path / "indexes"
        folder.mkdir()
        path = serve().files._path(SCENE)
        program = f"""
            import os, signal, numpy as np
            from pathlib import Path
            from mapless_server.scenes.retrieval import index_writer
            from mapless_server.scenes.retrieval.index_file import Identity
            from mapless_server.store import IndexedReference
            from mapless.geometry import RigidTransform
            os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)
            one = IndexedReference("a", "b", RigidTransform(np.eye(3), np.zeros(3)), np.ones(16, np.float32))
            content = index_writer.Content(Identity("", "", 0, "", 16), 1, "", [[one]])
            path = Path({str(path)!r})
            with index_writer.unfinished(path) as file:
                index_writer.write_index(path, file, content)
        """
        killed = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], check=False)
        assert killed.returncode == -9
        assert [it.suffix for it in folder.iterdir()] == [".part"]
        indexes = serve()
        assert indexes.entries().file is None
        indexes.filed()
        assert [it.suffix for it in folder.iterdir()] == [".index"]

    def test_two_servers_on_one_folder_make_it_once(self, serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
        made: list[Path] = []
        write = index_writer.write_index

        def counted(path: Path, *arguments: object) -> None:
            write(path, *arguments)  # type: ignore[arg-type]
            made.append(path)

        monkeypatch.setattr(index_files, "write_index", counted)
        servers = [serve(), serve()]
        for it in servers:
            it.entries()
        assert len({it.filed().file.path for it in servers}) == 1  # type: ignore[union-attr]
        assert servers[0].found() == servers[1].found()
        assert len(made) == 1

    def test_on_a_full_disk_the_scene_stays_in_memory(
        self, serve: Serve, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(index_files, "has_room", lambda *_: True)
        with small_disk(tmp_path / "small", 1) as folder:
            filler = folder / "filler"
            filler.write_bytes(bytes(shutil.disk_usage(folder).free - 8192))
            indexes = serve(folder, replace(OPTIONS, retry_s=3600.0))
            with caplog.at_level(logging.WARNING):
                expected = indexes.found()
                wait_until(lambda: caplog.records)
            assert "No space left" in caplog.text
            assert [*folder.iterdir()] == [filler]
            assert indexes.found() == expected
            filler.unlink()
            restarted = serve(folder)
            restarted.filed()
            assert restarted.found() == expected
            for it in (indexes, restarted):
                it.of_scenes.close()

    def test_a_disk_with_too_little_room_is_not_filled(self, tmp_path: Path) -> None:
        free = shutil.disk_usage(tmp_path).free
        assert index_writer.has_room(tmp_path, 1000, 1024)
        assert not index_writer.has_room(tmp_path, free // 4096, 1024)

    def test_it_yields_to_callers_and_ends_with_the_server(self, serve: Serve) -> None:
        indexes = serve(options=replace(OPTIONS, busy_share=1e-4))
        indexes.files.is_idle = lambda: False
        indexes.entries()
        wait_until(lambda: indexes.files._thread is not None)
        begin_s = time.monotonic()
        indexes.of_scenes.close()
        assert time.monotonic() - begin_s < 5
        assert indexes.entries().file is None


def test_descriptors_of_many_blocks_are_read_in_any_order(serve: Serve) -> None:
    entries = serve().filed()
    rows = entries.rows()
    assert len(rows) > 4 * BLOCK_ROWS
    similarity = entries.similarities(VECTORS[0], rows)
    for some in (rows[::3], rows[5:6], rows[-9:], rows[:0]):
        np.testing.assert_allclose(entries.similarities(VECTORS[0], some), similarity[some], atol=1e-6)
    vectors = np.array([entries.vector(int(row)) for row in rows])
    np.testing.assert_allclose(vectors @ VECTORS[0], similarity, atol=1e-6)


def test_nothing_of_it_is_open_after_it_is_freed(serve: Serve) -> None:
    def is_open(path: Path) -> bool:
        return any(os.path.realpath(it) == str(path) for it in Path("/proc/self/fd").iterdir())

    indexes = serve()
    path = indexes.filed().file.path  # type: ignore[union-attr]
    assert is_open(path)
    indexes.of_scenes._cached.forget(lambda *_: True)
    indexes.of_scenes.close()
    wait_until(lambda: not is_open(path))
