"""Depth maps of COLMAP's dense reconstruction: stereo/depth_maps/NAME.geometric.bin beside the undistorted images.

A map is the text "width&height&channels&" and then float32 values, little-endian, row by row; 0 where there is none
(COLMAP's documentation, "Dense reconstruction", and its scripts/python/read_write_dense.py). Its camera is that of the
undistorted image, scaled, its unit that of the model. Photometric maps, which no other image confirms, are not read.
"""

import math
import re
from pathlib import Path

import cv2
import numpy as np

from mapless_tools.dataset import DepthFile

from ..collecting import Collector

FOLDER = "stereo/depth_maps"
ENDING = ".geometric.bin"
MAX_PIXELS = 640 * 480
"""As many as a depth camera has; larger maps are reduced, for which a store would need megabytes."""
_HEAD = re.compile(rb"(\d{1,6})&(\d{1,6})&(\d{1,6})&")


def find_depths(*parents: Path) -> Path | None:
    """The first folder of depth maps in one of these folders; None if none has one."""
    return next((parent / FOLDER for parent in parents if (parent / FOLDER).is_dir()), None)


def depth_of_image(collector: Collector, folder: Path | None, name: str, photo: tuple[int, int]) -> DepthFile | None:
    """The map of an image in a folder of maps; None without one, or with a note if it cannot be used."""
    if folder is None or not (folder / f"{name}{ENDING}").is_file():
        return None
    return collector.depth(DepthFile(Path(f"{name}{ENDING}"), 1.0, decode=decode_map), photo, folder)


def decode_map(data: bytes) -> tuple[bytes, tuple[int, int]]:
    """Values and size (width, height) of a map's bytes, reduced to `MAX_PIXELS`; ValueError if they are not a map."""
    head = _HEAD.match(data)
    if head is None:
        raise ValueError("it does not begin as COLMAP's maps do, with width&height&channels&")
    width, height, channels = map(int, head.groups())
    if channels != 1:
        raise ValueError(f"it has {channels} channels, a depth map has one")
    values = data[head.end() :]
    if not 0 < 4 * width * height == len(values):
        raise ValueError(f"{width}x{height} values of 4 bytes are expected, {len(values)} bytes are there")
    depth = np.frombuffer(values, "<f4").reshape(height, width)
    if (factor := math.sqrt(MAX_PIXELS / depth.size)) < 1:
        width, height = max(1, int(factor * width)), max(1, int(factor * height))
        depth = np.asarray(cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT))
    return np.ascontiguousarray(depth, "<f4").tobytes(), (width, height)
