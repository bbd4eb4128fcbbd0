"""Captured calls and the folders that have them."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.lenses import RadialTangential
from mapless_server.services.capture.calls import (
    CapturedCall,
    CapturedPart,
    CapturedReference,
)
from mapless_server.services.capture.folder import CapturedEntry, CaptureFolder, Retention

NOW_S = 1_800_000_000.0


POSE = RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([1 / 3, 2e6, -0.1]))


CAMERA = Camera(640, 480, 500.1, 500.2, 319.7, 239.3, RadialTangential(0.1, 0.01, 1e-4, 2e-4, 1e-3))


ROOM = Retention(3600.0, 2**20)


IMAGES = {f"{i:064x}": bytes([i]) * 30_000 for i in range(8)}


def reference(number: int) -> CapturedReference:
    return CapturedReference(f"r{number}", f"key-{number}", CAMERA, POSE, f"{number:064x}", {})


def a_call(
    number: int = 0, references: tuple[int, ...] = (0, 1), time_s: float = NOW_S, size: int = 1000
) -> CapturedCall:
    part = CapturedPart("image", 7, tuple(map(reference, references)))
    request = np.random.default_rng(number).bytes(size)
    return CapturedCall(f"id-{number}", time_s, "Localize", "acme", "hall", 5, parts=(part,), request=request)


def blobs_of(call: CapturedCall) -> dict[str, bytes]:
    return {name: IMAGES[name] for name in call.blobs}


def files(folder: Path) -> list[Path]:
    return sorted(it for it in folder.rglob("*") if it.is_file() and it.name not in ("lock", "mapless-capture.json"))


def opened(path: Path, retention: Retention = ROOM, clock: Callable[[], float] = lambda: NOW_S) -> CaptureFolder:
    return CaptureFolder(path, retention, clock)


def write_one(path: Path) -> CapturedEntry:
    """The one call of a folder, which is closed again."""
    folder = opened(path)
    folder.add(a_call(), blobs_of(a_call()))
    (entry,) = folder.entries()
    folder.close()
    return entry


def refuse_to_delete(stuck: set[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """From now on files that are in the set cannot be deleted."""
    unlink = Path.unlink

    def refused(path: Path, missing_ok: bool = False) -> None:
        if path in stuck:
            raise PermissionError(1, "Operation not permitted")
        unlink(path, missing_ok)

    monkeypatch.setattr(Path, "unlink", refused)
