"""Storing references through a server that is busy, away, full, or refuses one of a message."""

import hashlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.layouts import CAMERA, truth, write_image

from mapless import (
    AlreadyExists,
    Internal,
    InvalidArgument,
    MaplessError,
    NewReference,
    NotFound,
    PermissionDenied,
    Reference,
    ResourceExhausted,
    Unavailable,
)
from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.ingest.existing import KnownReferences
from mapless_tools.ingest.report import ImportReport
from mapless_tools.ingest.upload import BATCH_COUNT, Uploader

Fault = Callable[[Sequence[NewReference], int], MaplessError | None]
"""The server's answer to a message, and to which call; None to store it."""

PARALLEL = 2


class Server:
    """Stands for the client and its server: stores messages whole, unless a fault is planted."""

    def __init__(self, fault: Fault = lambda message, call: None) -> None:
        self.stored: dict[str, Reference] = {}
        self.messages: list[list[str]] = []
        self.in_flight = self.most_in_flight = 0
        self.is_closed = False
        self._fault = fault
        self._lock = threading.Lock()

    def add_references(self, scene: str, references: Sequence[NewReference]) -> list[Reference]:
        with self._lock:
            self.messages.append([reference.reference_id for reference in references])
            call = len(self.messages)
            self.in_flight += 1
            self.most_in_flight = max(self.most_in_flight, self.in_flight)
        try:
            error = self._fault(references, call)
            if error is not None:
                raise error
            self.store(references)
            return list(map(as_stored, references))
        finally:
            with self._lock:
                self.in_flight -= 1

    def store(self, references: Sequence[NewReference]) -> None:
        with self._lock:
            if any(reference.reference_id in self.stored for reference in references):
                raise AlreadyExists("ALREADY_EXISTS", "the id is taken", field="requests[0].reference_id")
            self.stored |= {reference.reference_id: as_stored(reference) for reference in references}

    def get_reference(self, scene: str, reference_id: str) -> Reference:
        if reference_id not in self.stored:
            raise NotFound("NOT_FOUND", "no such reference")
        return self.stored[reference_id]

    def close(self) -> None:
        self.is_closed = True


def as_stored(new: NewReference) -> Reference:
    assert isinstance(new.image, bytes)
    sha256 = hashlib.sha256(new.image).hexdigest()
    now = datetime.now(timezone.utc)
    return Reference("s", new.reference_id, new.camera, new.world_from_camera, sha256, 9, now)


def frames_in(folder: Path, count: int = 20) -> list[Frame]:
    frames = []
    for i, pose in enumerate(truth(count).poses):
        write_image(folder / f"{i:03d}.png", seed=i)
        frames.append(Frame(f"r{i:03d}", folder / f"{i:03d}.png", CAMERA, pose))
    return frames


def upload(server: Any, frames: Sequence[Frame], parallel: int = PARALLEL) -> ImportReport:
    report = ImportReport("s", Dataset("d", tuple(frames), True, ""), frames)
    Uploader(server, KnownReferences(server.stored.values()), report, parallel, lambda *_: None).run()
    return report


def names(frames: Sequence[Frame]) -> list[str]:
    return [frame.name for frame in frames]


def refusals(report: ImportReport) -> dict[str, str]:
    return {item.frame: item.reason for item in report.refused}


def test_messages_are_bounded_and_few_are_in_flight(tmp_path: Path) -> None:
    frames = frames_in(tmp_path)
    server = Server()
    report = upload(server, frames)
    assert report.went_well
    assert sorted(report.added) == sorted(server.stored) == names(frames)
    assert max(map(len, server.messages)) <= BATCH_COUNT
    assert server.most_in_flight <= PARALLEL
    assert server.stored["r007"].image_sha256 == hashlib.sha256(frames[7].image_path.read_bytes()).hexdigest()


def test_a_difference_to_what_is_stored_is_refused_with_detail(tmp_path: Path) -> None:
    frames = frames_in(tmp_path, 4)
    server = Server()
    upload(server, frames)
    write_image(frames[0].image_path, seed=99)
    moved = replace(frames[1], world_from_camera=frames[1].world_from_camera.shifted([0, 0.05, 0]))
    zoomed = replace(frames[2], camera=replace(CAMERA, focal_x_px=90.0))
    report = upload(server, [frames[0], moved, zoomed, frames[3]])
    assert not report.went_well
    why = refusals(report)
    assert "its image differs" in why["r000"]
    assert "0.05 m" in why["r001"]
    assert "focal_x_px is 80.0, not 90.0" in why["r002"]
    assert [item.frame for item in report.skipped] == ["r003"]


@pytest.mark.parametrize(
    ("moved_m", "turned_deg", "is_same"),
    [(9e-4, 0.0, True), (0.0, 9e-3, True), (1.1e-3, 0.0, False), (0, 0.011, False)],
)
def test_the_same_photo_with_almost_the_same_pose_is_skipped(
    tmp_path: Path, moved_m: float, turned_deg: float, is_same: bool
) -> None:
    (frame,) = frames_in(tmp_path, 1)
    far = replace(frame, world_from_camera=frame.world_from_camera.shifted([4e5, 5e6, 0]))
    server = Server()
    upload(server, [far])
    moved = far.world_from_camera.shifted([moved_m, 0, 0])
    turned = RigidTransform(moved.rotation @ rotation_from_vector([np.radians(turned_deg), 0, 0]), moved.translation)
    report = upload(server, [replace(far, world_from_camera=turned)])
    assert (len(report.skipped), len(report.refused)) == ((1, 0) if is_same else (0, 1))
    assert (report.went_well, report.added, len(server.messages)) == (is_same, [], 1)


def test_what_is_refused_is_not_counted_as_stored(tmp_path: Path) -> None:
    frames = frames_in(tmp_path, 4)
    frames[1].image_path.write_bytes(b"")
    progress: list[tuple[int, int]] = []
    report = ImportReport("s", Dataset("d", tuple(frames), True, ""), frames)
    uploader = Uploader(Server(), KnownReferences([]), report, PARALLEL, lambda step, *counts: progress.append(counts))  # type: ignore[arg-type]
    uploader.run()
    assert progress == [(0, 4), (3, 3)]


def test_the_same_image_under_another_id_is_the_same_reference(tmp_path: Path) -> None:
    frames = frames_in(tmp_path, 3)
    twin = Frame("twin", frames[0].image_path, CAMERA, frames[0].world_from_camera)
    elsewhere = Frame("elsewhere", frames[1].image_path, CAMERA, RigidTransform.identity())
    report = upload(Server(), [*frames, twin, elsewhere], 1)
    assert [(item.frame, item.reason) for item in report.skipped] == [("twin", "the same image as r000")]
    assert "as r001" in refusals(report)["elsewhere"]


def test_a_photograph_refused_by_the_server_is_taken_out_alone(tmp_path: Path) -> None:
    """It names which of the message it is."""

    def fault(message: Sequence[NewReference], call: int) -> MaplessError | None:
        for i, reference in enumerate(message):
            if reference.reference_id in ("r003", "r005"):
                return InvalidArgument("INVALID_ARGUMENT", "cannot be decoded", field=f"requests[{i}].reference.image")
        return None

    frames = frames_in(tmp_path, 10)
    report = upload(Server(fault), frames)
    assert refusals(report) == dict.fromkeys(("r003", "r005"), "reference.image: cannot be decoded")
    assert len(report.added) == 8


@pytest.mark.parametrize(
    "error",
    [
        InvalidArgument("INVALID_ARGUMENT", "something is wrong"),
        ResourceExhausted("RESOURCE_EXHAUSTED", "the message is too large"),
        Internal("INTERNAL", "internal error", request_id="abc"),
    ],
)
def test_an_unnamed_refusal_is_located_by_sending_parts(tmp_path: Path, error: MaplessError) -> None:
    def fault(message: Sequence[NewReference], call: int) -> MaplessError | None:
        return error if any(reference.reference_id == "r006" for reference in message) else None

    report = upload(Server(fault), frames_in(tmp_path, 10))
    (reason,) = refusals(report).values()
    assert error.message in reason
    assert error.request_id in reason
    assert (len(report.added), report.stopped) == (9, "")


def test_what_another_caller_stores_meanwhile_is_refused_alone(tmp_path: Path) -> None:
    frames = frames_in(tmp_path, 4)
    server = Server()

    def fault(message: Sequence[NewReference], call: int) -> MaplessError | None:
        if call == 1:
            server.store([replace(message[1], image=b"another")])
        return None

    server._fault = fault
    report = upload(server, frames, 1)
    assert refusals(report) == {"r001": "is there already, but its image differs"}
    assert report.added == ["r000", "r002", "r003"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (ResourceExhausted("RESOURCE_EXHAUSTED", "disk", reason="STORE_FULL", retry_after_s=1.0), "disk: free space"),
        (Unavailable("UNAVAILABLE", "no route"), "cannot be reached: no route"),
        (ResourceExhausted("RESOURCE_EXHAUSTED", "busy", retry_after_s=0.2), "stays too busy"),
        (PermissionDenied("PERMISSION_DENIED", "may not write"), "may not write"),
    ],
)
def test_what_hits_all_ends_the_import_and_the_next_run_goes_on(
    tmp_path: Path, error: MaplessError, message: str
) -> None:
    server = Server(lambda references, call: error if call > 1 else None)
    frames = frames_in(tmp_path)
    report = upload(server, frames, 1)
    assert message in report.stopped
    assert not report.went_well
    assert report.untried_count == 20 - BATCH_COUNT
    assert (len(report.added), report.refused) == (BATCH_COUNT, [])
    server._fault = lambda references, call: None
    assert upload(server, frames).went_well
    assert sorted(server.stored) == names(frames)


def test_an_interruption_ends_it_soon_and_keeps_what_is_in(tmp_path: Path) -> None:
    """Ctrl-C comes as an exception in the thread that waits."""
    began = threading.Event()

    class Interrupted(Server):
        def add_references(self, scene: str, references: Sequence[NewReference]) -> list[Reference]:
            stored = super().add_references(scene, references)
            if len(self.messages) == 1:
                began.set()
                raise KeyboardInterrupt
            return stored

    server = Interrupted()
    with pytest.raises(KeyboardInterrupt):
        upload(server, frames_in(tmp_path), 1)
    assert began.is_set()
    assert (server.is_closed, len(server.messages)) == (True, 1)
