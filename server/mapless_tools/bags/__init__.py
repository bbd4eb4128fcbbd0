"""Recordings of robots (rosbag2, MCAP): messages, images with their camera, and poses by time.

`ingest.formats.rosbag` converts a recording to a dataset, `replay.bags` localizes its images. Imports the client and
the package `rosbags`. Begin with `source`.
"""

from pathlib import Path

SUFFIXES = (".mcap", ".db3")
"""Suffixes of the files of a recording."""


def is_recording(path: Path) -> bool:
    """Whether a path is the folder of a rosbag2, or a file of one."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or bool(storages(path))
    return path.is_file() and path.suffix in SUFFIXES


def storages(folder: Path) -> list[Path]:
    """Files of a folder that contain messages."""
    return sorted(it for it in folder.iterdir() if it.suffix in SUFFIXES)
