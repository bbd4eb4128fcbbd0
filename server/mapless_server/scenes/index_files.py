"""The index files of large scenes: made in a thread of their own, opened where they are those of the store's scene.

A server needs none: without a file a scene is read into memory and searched exactly. So a file that is damaged, of
another version or of another scene is not used, and what cannot be made is tried again later.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field
from functools import partial
from hashlib import blake2b
from pathlib import Path
from typing import BinaryIO, TypeVar

from mapless_server.bounds import check_bounds
from mapless_server.errors import NotFound, RequestError
from mapless_server.security import SceneKey
from mapless_server.store import IndexedReference, SceneChanges, Store
from mapless_server.store.portions import IndexReader

from .observer import BackgroundObserver
from .pacing import Pace
from .retrieval.index import Entries, GlobalDescriptor, SceneIndex
from .retrieval.index_file import Header, Identity, IndexDamaged, IndexFile, NotThisIndex
from .retrieval.index_writer import UNFINISHED, BeingMade, Content, Making, has_room, unfinished, write_index
from .retrieval.lists import ListOptions

T = TypeVar("T")

Read = tuple[SceneIndex, Collection[str]]
"""An index, and the ids of references that are left out because they are damaged in the store."""

log = logging.getLogger(__name__)

_PORTION = 2000
_BEING_MADE_S = 10.0
"""Time between two looks whether another server has made a file."""


@dataclass(frozen=True)
class IndexFileOptions:
    """Conditions for a scene's file, and for making it again.

    Attributes:
        least_references: smaller scenes are searched exactly, in memory.
        changed_share: a file is made again when more of its references than this have been added or deleted since;
        least_changed: and more than so many, each of which every search compares.
        longest_kept_s: a file with deleted references is made again after this time, so that they do not stay in it.
        retry_s: time after a failure in which a scene's file is not made.
        busy_share: share of one core that is used while the server computes for callers.
        lists: options of the lists.
    """

    least_references: int = 100_000
    changed_share: float = 0.05
    least_changed: int = 10_000
    longest_kept_s: float = 24 * 3600.0
    retry_s: float = 600.0
    busy_share: float = 0.05
    lists: ListOptions = field(default_factory=ListOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "least_references least_changed", at_least=1)
        check_bounds(self, "changed_share busy_share", above=0, at_most=1)
        check_bounds(self, "longest_kept_s retry_s", at_least=0)


def again_if_damaged(use: Callable[[], T]) -> T:
    """Calls a function that uses an index; once more, without the file, if it finds that this is damaged."""
    try:
        return use()
    except IndexDamaged:
        return use()


class _Closing(Exception):
    """The server ends."""


class IndexFiles:
    """The files of one descriptor in a folder; thread-safe. The thread starts when the first file is to be made."""

    def __init__(
        self,
        store: Store,
        descriptor: GlobalDescriptor,
        folder: Path,
        is_idle: Callable[[], bool] = lambda: True,
        observer: BackgroundObserver | None = None,
        options: IndexFileOptions | None = None,
    ) -> None:
        """Makes the object; `is_idle` is whether the server computes nothing for a caller."""
        self.options = options or IndexFileOptions()
        self.is_idle = is_idle
        self._store = store
        self._reader = IndexReader(store.database)
        self._store_hash = blake2b(store.database.name.encode(), digest_size=16).hexdigest()
        self._descriptor = descriptor
        self._folder = folder
        self._observer = observer or BackgroundObserver()
        self._lock = threading.Lock()
        self._wanted: queue.SimpleQueue[tuple[SceneKey, Callable[[SceneIndex], None]] | None] = queue.SimpleQueue()
        self._waiting: set[SceneKey] = set()
        self._useless: dict[Path, tuple[int, int] | None] = {}
        self._rests_until_s: dict[SceneKey, float] = {}
        self._readers = ThreadPoolExecutor(max_workers=1, thread_name_prefix="large scenes")
        self._pace = Pace(lambda: self.is_idle(), self.options.busy_share)
        self._thread: threading.Thread | None = None

    def open(self, scene_key: SceneKey) -> Read | None:
        """Opens the index of a scene, as it is in the store; None if there is no file that is certainly of it."""
        path = self._path(scene_key)
        version = _version_of(path)
        if version is None or version == self._useless.get(path):  # the store need not be asked
            return None
        try:
            return self._current(scene_key, IndexFile(path, self._identity(scene_key)))
        except (FileNotFoundError, NotFound):  # the file or the scene has just been deleted
            return None
        except (NotThisIndex, IndexDamaged, OSError) as error:
            log.warning("the index file of scene %s is not used, and is made again: %s", scene_key, error)
            if not isinstance(error, OSError):
                self.discard(scene_key)
            return None

    def is_large(self, scene_key: SceneKey) -> bool:
        """Whether a scene is large enough for a file."""
        return self._reader.count(scene_key) >= self.options.least_references

    def read(self, scene_key: SceneKey) -> Future[Read]:
        """Reads a large scene into memory, in portions, which takes less memory than all at once, in a thread.

        As it was at a generation. A million references take longer than callers wait; what has been read is not lost
        when they end. The result raises NotFound if there is no such scene.
        """
        return self._readers.submit(self._read, scene_key)

    def _read(self, scene_key: SceneKey) -> Read:
        begin_s = time.monotonic()
        state = self._reader.read_state(scene_key)
        index, damaged_ids = SceneIndex(self._descriptor.dimension), set[str]()
        for portion in self._portions(scene_key, damaged_ids):
            if self._pace.closing.is_set():
                raise _Closing
            index.apply(SceneChanges(state.generation, portion, frozenset(), False))
        took_s = time.monotonic() - begin_s
        log.info("scene %s, which has no index file, was read into memory in %.0f s", scene_key, took_s)
        return index, damaged_ids

    def write(self, scene_key: SceneKey) -> None:
        """Writes the file of a scene as it is now, with at least one reference.

        NotFound if there is no such scene; BeingMade while another server writes the file; OSError if there is no room.
        """
        with self._unfinished(scene_key) as file:
            self._write(scene_key, file)

    def is_due(self, entries: Entries) -> bool:
        """Whether a scene needs a file, or another one."""
        options = self.options
        if entries.file is None:
            return len(entries) >= options.least_references and entries.described_count >= options.least_references
        new, gone = entries.changed_counts()
        if new + gone > max(options.least_changed, options.changed_share * len(entries)):
            return True
        return gone > 0 and time.time() - entries.file.made_time_s > options.longest_kept_s

    def want(self, scene_key: SceneKey, adopt: Callable[[SceneIndex], None]) -> None:
        """Has a scene's file made; `adopt` then gets its index, in the thread."""
        if self._store.database.only_reads:
            return
        with self._lock:
            rests = time.monotonic() < self._rests_until_s.get(scene_key, 0.0)
            if rests or scene_key in self._waiting or self._pace.closing.is_set():
                return
            self._waiting.add(scene_key)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="index files", daemon=True)
                self._thread.start()
        self._wanted.put((scene_key, adopt))

    def discard(self, scene_key: SceneKey) -> None:
        """Deletes the file of a scene that is damaged, or of a scene that was deleted.

        One that cannot be deleted, as on a disk that can only be read, is not opened any more.
        """
        path = self._path(scene_key)
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            log.warning("the index file %s cannot be deleted: %s", path, error)
            self._useless[path] = _version_of(path)

    def close(self) -> None:
        """Ends the thread after its current step; a file that it makes is given up."""
        self._pace.closing.set()
        self._readers.shutdown(cancel_futures=True)
        self._wanted.put(None)
        if self._thread is not None:
            self._thread.join()

    def _path(self, scene_key: SceneKey) -> Path:
        return self._folder / self._identity_of(scene_key, 0).file_name()

    def _identity(self, scene_key: SceneKey) -> Identity:
        return self._identity_of(scene_key, self._reader.read_state(scene_key).create_time_us)

    def _identity_of(self, scene_key: SceneKey, create_time_us: int) -> Identity:
        name, dimension = self._descriptor.name, self._descriptor.dimension
        return Identity(self._store_hash, scene_key, create_time_us, name, dimension)

    def _current(self, scene_key: SceneKey, file: IndexFile) -> Read:
        """The index of a file with what has changed since; NotThisIndex if the store has had another history."""
        index, generation = SceneIndex(self._descriptor.dimension, file), file.header.generation
        damaged_ids = {*file.damaged_ids}
        while True:
            state = self._reader.read_state(scene_key, generation)
            if state.last_change != file.header.last_change:
                raise NotThisIndex("the store has had another history")
            changes = self._store.list_changes(scene_key, index.generation, self._descriptor.name)
            if changes.is_whole:
                raise NotThisIndex("it is too old")
            index.apply(changes)
            damaged_ids.update(changes.damaged)
            damaged_ids.difference_update(it.reference_id for it in changes.added)
            if index.generation == state.generation:
                break
        if len(index.entries()) + len(damaged_ids) != state.reference_count:
            raise NotThisIndex("it does not have as many references as the store")
        return index, damaged_ids

    def _run(self) -> None:
        while (wanted := self._wanted.get()) is not None and not self._pace.closing.is_set():
            scene_key, adopt = wanted
            try:
                self._delete_abandoned()
                self._make(scene_key, adopt)
            except _Closing:
                return
            except (NotFound, BeingMade) as error:  # the scene was deleted, or another server makes the file
                log.info("no index file of scene %s is made: %s", scene_key, error)
                self._rest(scene_key, min(_BEING_MADE_S, self.options.retry_s))
            except Exception as error:
                self._observer.count("background_failures")
                log.warning(
                    "the index file of scene %s could not be made, next time in %.0f s; until then a search compares "
                    "all references, which takes longer: %s",
                    scene_key,
                    self.options.retry_s,
                    error,
                    exc_info=None if isinstance(error, OSError | RequestError) else error,
                )
                self._rest(scene_key, self.options.retry_s)
            finally:
                with self._lock:
                    self._waiting.discard(scene_key)

    def _rest(self, scene_key: SceneKey, rest_s: float) -> None:
        self._rests_until_s[scene_key] = time.monotonic() + rest_s

    def _make(self, scene_key: SceneKey, adopt: Callable[[SceneIndex], None]) -> None:
        with self._unfinished(scene_key) as file:
            opened = self.open(scene_key)  # maybe one that another server has made
            if opened is None or self.is_due(opened[0].entries()):
                begin_s, cpu_begin_s = time.monotonic(), time.thread_time()
                self._write(scene_key, file)
                took_s, cpu_s = time.monotonic() - begin_s, time.thread_time() - cpu_begin_s
                self._observer.count("background_cpu_seconds", cpu_s)
                log.info(
                    "the index file of scene %s was made in %.0f s, %.0f of them computing", scene_key, took_s, cpu_s
                )
                opened = self.open(scene_key)
        if opened is not None:
            adopt(opened[0])
        else:
            self._discard_of_deleted(scene_key)

    def _unfinished(self, scene_key: SceneKey) -> AbstractContextManager[BinaryIO]:
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        return unfinished(self._path(scene_key))

    def _write(self, scene_key: SceneKey, file: BinaryIO) -> None:
        state = self._reader.read_state(scene_key)
        if not has_room(self._folder, state.reference_count, self._descriptor.dimension):
            raise OSError(f"the disk of {self._folder} has too little room")
        damaged_ids = set[str]()
        self._pace.begin_step()
        content = Content(
            self._identity_of(scene_key, state.create_time_us),
            state.generation,
            state.last_change,
            self._portions(scene_key, damaged_ids),
            damaged_ids,
        )
        write_index(self._path(scene_key), file, content, Making(self.options.lists, self._pause))

    def _portions(self, scene_key: SceneKey, damaged_ids: set[str]) -> Iterator[tuple[IndexedReference, ...]]:
        read = partial(self._reader.read_portion, scene_key, count=_PORTION, descriptor_name=self._descriptor.name)
        portion = read("")
        while portion.last_id:
            damaged_ids.update(portion.damaged)
            yield portion.references
            portion = read(portion.last_id)

    def _pause(self) -> None:
        """Ends a step: waits while the server computes for callers, as long as `busy_share` demands."""
        self._pace.end_step()
        if self._pace.closing.is_set():
            raise _Closing

    def _delete_abandoned(self) -> None:
        """Deletes files of scenes of this store that do not exist any more, and what killed processes have left."""
        for path in self._folder.glob("*.index"):
            header = _header_of(path)
            if header is None or header.identity.store != self._store_hash:
                continue
            if not self._exists(SceneKey(header.identity.scene)):
                path.unlink(missing_ok=True)
        for path in self._folder.glob(f"*{UNFINISHED}"):
            with suppress(BeingMade), unfinished(path):
                pass

    def _discard_of_deleted(self, scene_key: SceneKey) -> None:
        """Deletes the file of a scene that was deleted while it was made."""
        if not self._exists(scene_key):
            self.discard(scene_key)

    def _exists(self, scene_key: SceneKey) -> bool:
        try:
            self._store.get_generation(scene_key)
        except NotFound:
            return False
        return True


def _version_of(path: Path) -> tuple[int, int] | None:
    """Distinguishes a file from others of its name; None if there is none."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_mtime_ns


def _header_of(path: Path) -> Header | None:
    """The header of a file; None if it is none."""
    try:
        with path.open("rb") as file:
            return Header.read(file.fileno())
    except (NotThisIndex, OSError):
        return None
