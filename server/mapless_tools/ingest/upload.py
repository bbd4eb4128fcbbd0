"""Stores references through a server: several concurrent messages, each stored completely or not at all.

Only the references that are being sent are in memory. The client waits for a server that is busy or away, and stores
nothing twice where the answer to a message was lost; the references of a rejected message are sent one by one.
"""

from __future__ import annotations

import hashlib
import re
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

from mapless import Client, DepthImage, NewReference, errors
from mapless.depth import depth_from_message, depth_to_message
from mapless.provenance import ADOPTED
from mapless.wire import FieldError
from mapless_server.errors import InvalidArgument as BadImage
from mapless_server.images import ANY_SIZE, ImageLimits, check_depth, check_mask, image_size
from mapless_tools.dataset import DepthFile, Frame, Refusal
from mapless_tools.progress import Progress

from .existing import Identity, KnownReferences, Stored, difference
from .report import ALREADY_THERE, ImportReport

BATCH_COUNT = 8
"""References a message: progress shows, and little is sent again when one is refused."""
STORE_FULL = "STORE_FULL"
_REQUEST = re.compile(r"requests\[\d+\]")
Item = tuple[NewReference, Stored]
"""A reference that is ready to be sent, and what identifies it."""


class _Stopped(Exception):
    """Ends the import; the reason is in the report."""


class Uploader:
    """Stores frames by so many messages at a time, and writes the results into a report."""

    def __init__(
        self, client: Client, known: KnownReferences, report: ImportReport, parallel: int, progress: Progress
    ) -> None:
        self._client = client
        self._known = known
        self._report = report
        self._parallel = parallel
        self._progress = progress
        self._stop = threading.Event()
        self._lock = threading.Lock()

    def run(self) -> None:
        """Stores the chosen frames that are not refused already; an interruption stops it soon and is raised.

        Adopted ones are stored last, so that what vouches for them is there before.
        """
        refused = {it.frame for it in self._report.refused[len(self._report.dataset.refused) :]}
        frames = [frame for frame in self._report.chosen if frame.name not in refused]
        adopted = [frame for frame in frames if frame.provenance.source == ADOPTED]
        surveyed = [frame for frame in frames if frame.provenance.source != ADOPTED]
        self._progress("storing references", 0, len(frames))
        start_s = time.monotonic()
        threads = ThreadPoolExecutor(self._parallel, "import")
        try:
            for some in (surveyed, adopted):
                batches = (some[i : i + BATCH_COUNT] for i in range(0, len(some), BATCH_COUNT))
                workers = [threads.submit(self._work, batches) for _ in range(self._parallel)]
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
                self._send([item for frame in batch if (item := self._load(frame)) is not None])
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
        """The frame's reference; None if it is not to be sent, with the reason in the report."""
        try:
            new, stored = read_item(frame)
        except ValueError as error:
            self._refuse(frame.name, str(error))
            return None
        there = self._known.claim(stored)
        if there is None:
            return new, stored
        self._duplicate(there, stored)
        return None

    def _send(self, items: Sequence[Item]) -> None:
        if not items:
            return
        if self._stop.is_set():
            raise _Stopped
        try:
            stored = self._client.add_references(self._report.scene, [new for new, _ in items])
        except errors.ResourceExhausted as error:
            if error.reason == STORE_FULL:
                self._end(f"{error.message}: free space, then import again")
            if error.retry_after_s is not None:
                self._end(f"the server stays too busy: {error.message}")
            self._one_by_one(items, error)
        except (errors.Unavailable, errors.DeadlineExceeded) as error:
            self._report.is_server_gone = True
            self._end(f"the server cannot be reached: {error.message}")
        except (errors.AlreadyExists, errors.InvalidArgument, errors.Internal) as error:
            self._one_by_one(items, error)
        except errors.MaplessError as error:
            self._end(str(error))
        else:
            with self._lock:
                self._report.added += [it.reference_id for it in stored]
                self._report.blank += [it.reference_id for it in stored if not it.feature_count]

    def _one_by_one(self, items: Sequence[Item], error: errors.MaplessError) -> None:
        """Sends the references of a rejected message one by one, and refuses one that is rejected alone."""
        if len(items) > 1:
            for item in items:
                self._send([item])
            return
        ((new, stored),) = items
        self._known.forget(stored)
        if isinstance(error, errors.AlreadyExists):  # by another caller, meanwhile
            self._duplicate(self._client.get_reference(self._report.scene, new.reference_id), stored)
            return
        field = _REQUEST.sub("", error.field or "").lstrip(".")
        request = f" (request {error.request_id})" if isinstance(error, errors.Internal) else ""
        self._refuse(new.reference_id, f"{f'{field}: ' if field else ''}{error.message}{request}")

    def _duplicate(self, there: Identity, new: Stored) -> None:
        what = difference(there, new)
        here = "" if there.reference_id == new.reference_id else f"the same image as {there.reference_id}"
        if not what:
            with self._lock:
                self._report.skipped.append(Refusal(new.reference_id, here or ALREADY_THERE))
        else:
            as_another = f" as {there.reference_id}" if here else ""
            self._refuse(new.reference_id, f"is there already{as_another}, but {what}")

    def _refuse(self, name: str, reason: str) -> None:
        with self._lock:
            self._report.refused.append(Refusal(name, reason))

    def _end(self, reason: str) -> NoReturn:
        """Ends the import; the first reason is reported."""
        with self._lock:
            if not self._stop.is_set():
                self._report.stopped = reason
            self._stop.set()
        raise _Stopped


def read_item(frame: Frame, limits: ImageLimits = ANY_SIZE) -> Item:
    """Reads a frame's image, mask and depth; ValueError if they cannot be a photograph of its camera and its parts."""
    camera = frame.camera
    with _named(frame.image_path):
        image = frame.image_path.read_bytes()
        width, height = image_size(image, limits)
    if (width, height) != (camera.width_px, camera.height_px):
        raise ValueError(
            f"{frame.image_path} has {width}x{height} pixels, its camera {camera.width_px}x{camera.height_px}"
        )
    mask = None
    if frame.mask_path is not None:
        with _named(frame.mask_path):
            mask = frame.mask_path.read_bytes()
            check_mask(mask, (width, height), limits)
    digests = [hashlib.sha256(it).hexdigest() if it else "" for it in (image, mask)]
    depth = None if frame.depth is None else _read_depth(frame.depth, (width, height), limits)
    new = NewReference(frame.name, image, camera, frame.world_from_camera, mask, frame.provenance, depth)
    depth_sha256 = "" if depth is None else depth.sha256
    pose = frame.world_from_camera
    return new, Stored(frame.name, digests[0], camera, pose, digests[1], depth_sha256, frame.provenance)


def _read_depth(file: DepthFile, size: tuple[int, int], limits: ImageLimits) -> DepthImage:
    """Reads a depth as a server gets it; ValueError names the file."""
    with _named(file.path):
        depth = file.read()
        try:
            sent = depth_from_message(depth_to_message(depth), "depth")
        except FieldError as error:
            raise ValueError(f"{file.path}: {error}") from None
        check_depth(sent, size, limits)
        return sent


@contextmanager
def _named(file: Path) -> Iterator[None]:
    """Makes an error of reading a file, or of what it holds, a ValueError that names it."""
    try:
        yield
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except BadImage as error:
        raise ValueError(f"{file}: {error}") from error
