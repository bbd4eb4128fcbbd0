"""A call in the folder, and when it goes: the limit of time.

It goes when the clock says so, or when so much time has passed since it was written or found, whichever is sooner: so
a clock that is set meanwhile keeps nothing.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from mapless_server.security.tenancy import SceneKey, key_of

from .calls import CapturedCall, DamagedCapture, decode_call
from .files import blob_path, call_path, space_of

_FUTURE_S = 60.0
"""A call that is further ahead of the clock than this was captured while the clock was wrong."""


@dataclass(frozen=True, eq=False)
class Held:
    """A call in the folder.

    Attributes:
        path: its file.
        scene_key: of its scene.
        scene_created_us: which of the scenes that had this name.
        references: id and key of each.
        blobs: files that it needs.
        space_bytes: of its own file.
        expiry_s: when it goes, Unix seconds.
        expiry_monotonic_s: the same by a clock that nobody sets.
    """

    path: Path
    scene_key: SceneKey
    scene_created_us: int
    references: frozenset[tuple[str, str]]
    blobs: frozenset[Path]
    space_bytes: int
    expiry_s: float
    expiry_monotonic_s: float

    def left_s(self, now_s: float, monotonic_s: float) -> float:
        """How long it may stay; not above 0 if it is to go."""
        return min(self.expiry_s - now_s, self.expiry_monotonic_s - monotonic_s)


def held_of(folder: Path, path: Path, call: CapturedCall, size_bytes: int, keep_s: float, now_s: float) -> Held:
    """What is to be known of a call that is kept for so long, and whose file has so many bytes."""
    expiry_s = call.time_s + keep_s
    return Held(
        path,
        key_of(call.tenant, call.scene_id),
        call.scene_created_us,
        call.keys,
        frozenset(blob_path(folder, call.tenant, name) for name in call.blobs),
        space_of(size_bytes),
        expiry_s,
        time.monotonic() + min(expiry_s - now_s, keep_s),
    )


def read_held(folder: Path, path: Path, keep_s: float, max_bytes: int, now_s: float) -> Held:
    """The call of a file that lies in the folder.

    Raises:
        DamagedCapture: it is not what was written there, or is of the future: nothing limits its time.
        CaptureError: its format is newer than this program.
    """
    if path.stat().st_size > max_bytes:
        raise DamagedCapture("it is larger than all calls may be")
    data = path.read_bytes()
    call = decode_call(data)
    if path.parent != call_path(folder, call.tenant, call.scene_id, "").parent:
        raise DamagedCapture("it is another tenant's or scene's")
    if call.time_s > now_s + _FUTURE_S:
        raise DamagedCapture("it was captured later than now")
    return held_of(folder, path, call, len(data), keep_s, now_s)
