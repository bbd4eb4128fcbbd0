"""Stores references through a server: several concurrent messages, each stored completely or not at all.

At most as many messages as threads are read ahead. The references of a rejected message are sent one by one; if the
server is busy or unreachable, the import waits. A message whose answer was lost may have been stored, so an existing
reference is compared before it is reported as a duplicate.
"""

from __future__ import annotations

import hashlib
import re
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from mapless import Client, NewReference, errors
from mapless_server.errors import InvalidArgument as BadImage
from mapless_server.images import image_size
from mapless_tools.dataset import Frame, Refusal
from mapless_tools.progress import Progress

from .existing import KnownReferences, Stored, difference, stored_of
from .formats.collecting import ANY_SIZE
from .report import ALREADY_THERE, ImportReport

BATCH_COUNT = 8
"""References a message: progress shows, and little is sent again when one is refused."""
BATCH_BYTES = 6 * 2**20
"""Of images a message; large ones take the server long to receive, which its other callers feel."""
STORE_FULL = "STORE_FULL"
_REQUEST = re.compile(r"requests\[\d+\]")


@dataclass(frozen=True)
class UploadOptions:
    """Options of storing.

    The server describes the photographs of parallel messages concurrently; more would only wait. The import gives up if
    the server is too busy for longer than `busy_patience_s`, or unreachable for longer than `away_patience_s`; a
    restart takes seconds.
    """

    parallel: int = 3
    busy_patience_s: float = 600.0
    away_patience_s: float = 60.0

    def __post_init__(self) -> None:
        if not 1 <= self.parallel <= 64:
            raise ValueError(f"--parallel is the number of messages in flight, 1 to 64, not {self.parallel}")
        if not (self.busy_patience_s > 0 and self.away_patience_s > 0):
            given = f"{self.busy_patience_s} and {self.away_patience_s}"
            raise ValueError(f"busy_patience_s and away_patience_s must be above 0, not {given}")


class _Stopped(Exception):
    """Ends the import; the reason is in the report."""


class Uploader:
    """Stores frames, and writes the results into a report."""

    def __init__(
        self, client: Client, known: KnownReferences, report: ImportReport, options: UploadOptions, progress: Progress
    ) -> None:
        self._client = client
        self._known = known
        self._report = report
        self._options = options
        self._progress = progress
        self._stop = threading.Event()
        self._lock = threading.Lock()

    def run(self) -> None:
        """Stores the report's chosen frames; an interruption stops it soon and is raised."""
        batches = batches_of(self._report.chosen)
        total = len(self._report.chosen)
        self._progress("storing references", 0, total)
        start_s = time.monotonic()
        threads = ThreadPoolExecutor(self._options.parallel, "import")
        try:
            workers = [threads.submit(self._work, batches) for _ in range(self._options.parallel)]
            for worker in workers:
                worker.result()
        except BaseException:
            self._stop.set()
            self._client.close()  # ends the calls in flight
            raise
        finally:
            threads.shutdown(wait=True)
            self._report.seconds = time.monotonic() - start_s

    def _work(self, batches: Iterator[Sequence[Frame]]) -> None:
        try:
            while not self._stop.is_set():
                with self._lock:
                    batch = next(batches, None)
                if batch is None:
                    return
                items = [item for frame in batch if (item := self._load(frame)) is not None]
                self._send(items)
                with self._lock:
                    report = self._report
                    refused = len(report.refused) - len(report.dataset.refused)
                    done = len(report.added) + len(report.skipped)
                    self._progress("storing references", done, len(report.chosen) - refused)
        except _Stopped:
            pass
        except BaseException:
            self._stop.set()
            raise

    def _load(self, frame: Frame) -> Item | None:
        """The frame with its image's bytes; None if it is not to be sent, with the reason in the report."""
        try:
            item = read_item(frame)
        except ValueError as error:
            self._refuse(frame, str(error))
            return None
        there = self._known.claim(item.stored)
        if there is None:
            return item
        self._duplicate(frame, there, item.stored)
        return None

    def _send(self, items: Sequence[Item]) -> None:
        waiting = Waiting(self._options, self._stop)
        left = list(items)
        while left:
            if self._stop.is_set():
                raise _Stopped
            try:
                stored = self._client.add_references(self._report.scene, [item.reference() for item in left])
            except errors.AlreadyExists as error:
                left = self._reconcile(left, waiting, error)
            except errors.ResourceExhausted as error:
                if error.reason == STORE_FULL:
                    self._end(f"{error.message}: free space, then import again")
                if error.retry_after_s is None:
                    self._one_by_one(left, error)
                    return
                if not waiting.for_busy(error.retry_after_s):
                    self._end(f"the server stays too busy: {error.message}")
            except (errors.Unavailable, errors.DeadlineExceeded) as error:
                waiting.lost_an_answer = True
                if not waiting.for_return():
                    self._end(f"the server cannot be reached: {error.message}")
            except (errors.InvalidArgument, errors.Internal) as error:
                self._one_by_one(left, error)
                return
            except errors.MaplessError as error:
                self._end(str(error))
            else:
                self._add(left)
                with self._lock:
                    self._report.blank += [it.reference_id for it in stored if not it.feature_count]
                return

    def _reconcile(self, items: Sequence[Item], waiting: Waiting, error: errors.AlreadyExists) -> list[Item]:
        """The items that do not exist yet, after an id was taken."""
        left = []
        for item in items:
            try:
                there = stored_of(self._client.get_reference(self._report.scene, item.frame.name))
            except errors.NotFound:
                left.append(item)
                continue
            except errors.MaplessError as failure:
                self._end(str(failure))
            if waiting.lost_an_answer and not difference(there, item.stored):
                self._add([item])
            else:
                self._duplicate(item.frame, there, item.stored)
        if len(left) == len(items):  # it existed, and does not any longer: another client is at work
            if waiting.for_return():
                return left
            self._end(str(error))
        return left

    def _one_by_one(self, items: Sequence[Item], error: errors.MaplessError) -> None:
        """Sends the references of a rejected message one by one, and refuses one that is rejected alone."""
        if len(items) > 1:
            for item in items:
                self._send([item])
            return
        field = _REQUEST.sub("", error.field or "").lstrip(".")
        request = f" (request {error.request_id})" if isinstance(error, errors.Internal) else ""
        self._refuse(items[0].frame, f"{f'{field}: ' if field else ''}{error.message}{request}")
        self._known.forget(items[0].stored)

    def _duplicate(self, frame: Frame, there: Stored, new: Stored) -> None:
        what = difference(there, new)
        here = "" if there.reference_id == frame.name else f"the same image as {there.reference_id}"
        if not what:
            with self._lock:
                self._report.skipped.append(Refusal(frame.name, here or ALREADY_THERE))
        else:
            self._refuse(frame, f"is there already{f' as {there.reference_id}' if here else ''}, but {what}")

    def _refuse(self, frame: Frame, reason: str) -> None:
        with self._lock:
            self._report.refused.append(Refusal(frame.name, reason))

    def _add(self, items: Sequence[Item]) -> None:
        with self._lock:
            self._report.added += [item.frame.name for item in items]

    def _end(self, reason: str) -> None:
        """Ends the import; the first reason is reported."""
        with self._lock:
            if not self._stop.is_set():
                self._report.stopped = reason
            self._stop.set()
        raise _Stopped


@dataclass(frozen=True, eq=False)
class Item:
    """A frame that is ready to be sent."""

    frame: Frame
    image: bytes
    stored: Stored

    def reference(self) -> NewReference:
        """The reference in the client's form."""
        return NewReference(self.frame.name, self.image, self.frame.camera, self.frame.world_from_camera)


def read_item(frame: Frame) -> Item:
    """Reads a frame's image; ValueError if it cannot be a photograph of the frame's camera."""
    file, camera = frame.image_path, frame.camera
    try:
        image = file.read_bytes()
        width, height = image_size(image, ANY_SIZE)
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except BadImage as error:
        raise ValueError(f"{file}: {error}") from error
    if (width, height) != (camera.width_px, camera.height_px):
        raise ValueError(f"{file} has {width}x{height} pixels, its camera {camera.width_px}x{camera.height_px}")
    stored = Stored(frame.name, hashlib.sha256(image).hexdigest(), camera, frame.world_from_camera)
    return Item(frame, image, stored)


def batches_of(frames: Sequence[Frame]) -> Iterator[Sequence[Frame]]:
    """Yields frames in their order, as many together as one message should have; their files are not read."""
    batch: list[Frame] = []
    batch_bytes = 0
    for frame in frames:
        try:
            size_bytes = frame.image_path.stat().st_size
        except OSError:  # reading it will report that
            size_bytes = 0
        if batch and (len(batch) == BATCH_COUNT or batch_bytes + size_bytes > BATCH_BYTES):
            yield batch
            batch, batch_bytes = [], 0
        batch.append(frame)
        batch_bytes += size_bytes
    if batch:
        yield batch


class Waiting:
    """Waits for the server on behalf of one message."""

    def __init__(self, options: UploadOptions, stop: threading.Event) -> None:
        self.lost_an_answer = False
        self._options = options
        self._stop = stop
        self._start_s = time.monotonic()
        self._away_s = 0.0

    def for_busy(self, retry_after_s: float) -> bool:
        """Waits as long as the server requests; returns False if it has been busy for too long."""
        if time.monotonic() - self._start_s > self._options.busy_patience_s:
            return False
        self._stop.wait(min(max(retry_after_s, 0.05), 30.0))
        return True

    def for_return(self) -> bool:
        """Waits a little longer each time; returns False if it has waited for too long."""
        if self._away_s >= self._options.away_patience_s:
            return False
        pause_s = min(max(0.5, self._away_s / 2), 5.0)
        self._stop.wait(pause_s)
        self._away_s += pause_s
        return True
