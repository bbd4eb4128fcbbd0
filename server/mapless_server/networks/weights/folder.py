"""The weights folder: one safetensors file for each name, and beside it its digest as sha256sum writes it."""

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from .catalogue import FolderError, Weights, WeightsMissing, named

_RECORD_SUFFIX = ".sha256"
_RECORD = re.compile(r"([0-9a-f]{64})  \S+\n?")


class Status(Enum):
    """The state of a file of weights, known without reading it."""

    ABSENT = "absent"
    OFFICIAL = "official"
    """Its recorded digest is the one of the catalogue."""
    UNOFFICIAL = "not official"
    """Its recorded digest is another."""
    RECORDED = "present"
    """It has a recorded digest, and the catalogue has none."""
    UNCHECKED = "not checked"
    """It has no recorded digest, or changed since the digest was recorded."""
    NO_FILE = "not a file"
    """The path is not a file, most likely a folder."""


@dataclass(frozen=True)
class Stored:
    """The entry of the folder for some weights, also if the file is absent, which has no size."""

    path: Path
    status: Status
    size_bytes: int | None = None


def find_weights(name: str, weights_dir: Path) -> Path:
    """Returns the file of some weights.

    WeightsMissing if it is not there, FolderError if the path is not a file, UnknownWeights for an unknown name.
    """
    weights = named(name)
    path = path_of(weights, weights_dir)
    if not os.path.isfile(path):  # False also where a folder may not be read
        raise WeightsMissing(
            f"the weights of {name} are not in {weights_dir}: run `mapless-server weights fetch {name}` "
            f"(licence {weights.licence})"
        )
    return path


def path_of(weights: Weights, weights_dir: Path) -> Path:
    """Returns the path of the file, present or not; FolderError if it exists and is not a file."""
    path = weights_dir / weights.file_name
    if os.path.exists(path) and not os.path.isfile(path):
        raise FolderError(f"{path} is not a file{' but a folder' if path.is_dir() else ''}: move it away")
    return path


def look_up(weights: Weights, weights_dir: Path) -> Stored:
    """Returns the state of a file by its recorded digest; `check` computes the digest, over gigabytes."""
    path = weights_dir / weights.file_name
    if not os.path.isfile(path):
        return Stored(path, Status.NO_FILE if os.path.exists(path) else Status.ABSENT)
    sha256 = recorded(path) if _is_fresh(path) else None
    if sha256 is None:
        status = Status.UNCHECKED
    elif weights.sha256 is None:
        status = Status.RECORDED
    else:
        status = Status.OFFICIAL if sha256 == weights.sha256 else Status.UNOFFICIAL
    return Stored(path, status, path.stat().st_size)


@contextmanager
def temporary_folder(weights_dir: Path) -> Iterator[Path]:
    """Makes a temporary folder inside the weights folder, which is created if it is missing.

    A finished file is renamed into place. The folder is removed at the end of the block, also after an exception.
    FolderError if the weights folder cannot be created or written.
    """
    try:
        weights_dir.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=".incoming-", dir=weights_dir))
    except OSError as error:
        raise FolderError(f"the weights folder {weights_dir} cannot be written: {error.strerror}") from None
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def put_in_place(ready: Path, weights: Weights, weights_dir: Path, sha256: str) -> Path:
    """Renames a file of the `temporary_folder` to its name, and records its digest."""
    path = weights_dir / weights.file_name
    if not ready.is_symlink():
        ready.chmod(0o644)  # the server may be another user
        with ready.open("rb") as stream:
            os.fsync(stream.fileno())
    os.replace(ready, path)
    record(path, sha256)
    return path


def record(path: Path, sha256: str) -> None:
    """Writes a file's digest beside it."""
    _record_of(path).write_text(f"{sha256}  {path.name}\n", encoding="ascii")


def recorded(path: Path) -> str | None:
    """Returns the digest recorded beside a file; None if there is none, or it is not readable."""
    try:
        match = _RECORD.fullmatch(_record_of(path).read_text(encoding="ascii"))
    except (OSError, UnicodeDecodeError):
        return None
    return match[1] if match else None


def _record_of(path: Path) -> Path:
    return path.with_name(path.name + _RECORD_SUFFIX)


def _is_fresh(path: Path) -> bool:
    """Whether the record was written after the file's last change (by ctime, since copying tools keep mtime)."""
    try:
        return _record_of(path).stat().st_mtime_ns >= path.stat().st_ctime_ns
    except OSError:
        return False
