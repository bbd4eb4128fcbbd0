"""Printed tags in photographs with known poses: drawn by their homography, with edges smooth in linear light."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, Similarity, rotation_from_vector
from mapless_server.images.exif import NO_EXIF, Exif
from mapless_tools.reconstruct.pictures import Part, Picture, PosedPicture
from mapless_tools.reconstruct.world.corners import LIGHT

Image = NDArray[np.uint8]
PART_FROM_WORLD = Similarity(1 / 0.37, rotation_from_vector([0.4, -1.1, 0.7]), np.array([3.0, -2.0, 5.0]))
"""The planted frame and unit of reconstructions: one unit is 0.37 m."""
MODULE_PX, FINE = 24, 4


@dataclass(frozen=True, eq=False)
class PrintedTag:
    """A tag on a sheet: x along its top, y down its side, z into the sheet; the edge of its black square in metres."""

    dictionary: int
    number: int
    edge_m: float
    world_from_tag: RigidTransform

    def paint(self, image: Image, camera: Camera, world_from_camera: RigidTransform) -> Image:
        """The photograph with the sheet in it, unless it is behind the camera."""
        modules = cv2.aruco.getPredefinedDictionary(self.dictionary).markerSize + 2
        side = MODULE_PX * modules
        black = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(self.dictionary), self.number, side)
        sheet = cv2.copyMakeBorder(black, MODULE_PX, MODULE_PX, MODULE_PX, MODULE_PX, cv2.BORDER_CONSTANT, value=(255,))
        half_m = self.edge_m / 2 * (modules + 2) / modules
        corners = half_m * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
        seen = camera.project(world_from_camera.inverse().apply(self.world_from_tag.apply(corners)))
        if not np.isfinite(seen).all():
            return image
        end = side + 2 * MODULE_PX - 0.5
        on_sheet = np.array([[-0.5, -0.5], [end, -0.5], [end, end], [-0.5, end]], np.float32)
        fine = (FINE * (seen + 0.5) - 0.5).astype(np.float32)
        homography = cv2.getPerspectiveTransform(on_sheet, fine)
        height, width = image.shape[:2]
        size = (FINE * width, FINE * height)
        sheet_seen = cv2.warpPerspective(sheet, homography, size, flags=cv2.INTER_AREA)
        cover = cv2.warpPerspective(np.full_like(sheet, 255), homography, size)
        light, share = (cv2.resize(it, (width, height), interpolation=cv2.INTER_AREA) for it in (sheet_seen, cover))
        on_tag = share > 0
        covered = (share[on_tag] / 255)[:, None]
        mixed = LIGHT[image[on_tag]] * (1 - covered) + covered * (0.02 + 0.6 * (light[on_tag] / 255)[:, None])
        painted = image.copy()
        painted[on_tag] = np.searchsorted(LIGHT, mixed).clip(0, 255)
        return painted


def photographed(
    folder: Path, camera: Camera, poses: Sequence[RigidTransform], tags: Sequence[PrintedTag], seed: int = 0
) -> Part:
    """Photographs of tags before a wall of noise, as a reconstruction in the planted frame and unit."""
    generator = np.random.default_rng(seed)
    posed = []
    for i, pose in enumerate(poses):
        noise = generator.integers(90, 130, (camera.height_px // 8, camera.width_px // 8, 3)).astype(np.uint8)
        size = (camera.width_px, camera.height_px)
        image: Image = np.asarray(cv2.resize(noise, size, interpolation=cv2.INTER_CUBIC), np.uint8)
        for tag in tags:
            image = tag.paint(image, camera, pose)
        posed.append(posed_picture(folder, f"photo-{i}", image, camera, pose))
    return part_of(posed)


def posed_picture(
    folder: Path, name: str, image: Image, camera: Camera, pose: RigidTransform, exif: Exif = NO_EXIF
) -> PosedPicture:
    """A photograph that is written to the folder, its pose in the planted frame and unit."""
    file = folder / f"{name}.png"
    cv2.imwrite(str(file), image)
    return posed_without_file(file, camera, pose, exif)


def posed_without_file(file: Path, camera: Camera, pose: RigidTransform, exif: Exif = NO_EXIF) -> PosedPicture:
    """A photograph whose file is never read, its pose in the planted frame and unit."""
    picture = Picture(file.stem, file, camera.width_px, camera.height_px, file, exif)
    return PosedPicture(picture, camera, PART_FROM_WORLD.transform_pose(pose), 100)


def part_of(posed: Sequence[PosedPicture], points: Array | None = None) -> Part:
    """A reconstruction with no points, or with these in the world."""
    at = np.zeros((0, 3)) if points is None else PART_FROM_WORLD.apply(points)
    return Part(tuple(posed), at, np.zeros_like(at), 0.5)


def looking(eye: Sequence[float], target: Sequence[float], up: Sequence[float] = (0.0, 0.0, 1.0)) -> RigidTransform:
    """A camera at a place that looks at another, upright."""
    ahead = np.array(target, float) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    return RigidTransform(np.column_stack([right, np.cross(ahead, right), ahead]), np.array(eye, float))
