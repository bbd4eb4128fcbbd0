"""Recordings of robots (rosbag2, MCAP): their messages, their images with camera, and poses by time.

`ingest.formats.rosbag` makes a dataset of one, `replay.bags` localizes one. Imports the client and the package
`rosbags`. Begin with `source`.
"""

from pathlib import Path

SUFFIXES = (".mcap", ".db3")
"""Of the files of a recording."""


def is_recording(path: Path) -> bool:
    """Whether a path is the folder of a rosbag2, or a file of one."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(storages(path))
    return path.is_file() and path.suffix in SUFFIXES


def storages(folder: Path) -> list[Path]:
    """The files of a folder that hold messages."""
    return sorted(it for it in folder.iterdir() if it.suffix in SUFFIXES)
