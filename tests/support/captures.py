"""Captured calls and the folders that have them."""

from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.services.capture.calls import CapturedCall, CapturedPart
from mapless_server.services.capture.folder import LOCK_FILE, MARKER_FILE, CaptureFolder

NOW_S = 1_800_000_000.0
POSE = RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([1 / 3, 2e6, -0.1]))


def a_call(number: int = 0, time_s: float = NOW_S, size: int = 1000) -> CapturedCall:
    part = CapturedPart("image", 7, {"r0": "key-0"})
    request = np.random.default_rng(number).bytes(size)
    return CapturedCall(f"id-{number}", time_s, "Localize", "acme", "hall", parts=(part,), request=request)


def files(folder: Path) -> list[Path]:
    return sorted(it for it in folder.rglob("*") if it.is_file() and it.name not in (LOCK_FILE, MARKER_FILE))


class Clock:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = NOW_S

    def __call__(self) -> float:
        return self.now_s


def opened(path: Path, keep_s: float = 3600.0, max_bytes: int = 2**20, clock: Clock | None = None) -> CaptureFolder:
    return CaptureFolder(path, keep_s, max_bytes, clock or Clock())


def filled(path: Path, count: int = 1) -> list[Path]:
    """The files of a folder with so many calls, which is closed again."""
    folder = opened(path)
    for number in range(count):
        folder.add(a_call(number, NOW_S - count + number))
    folder.close()
    return files(path)
