"""Local features of photographs, on the disk: descriptors of hundreds of photographs need not fit into memory."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera
from mapless_server import __version__
from mapless_server.images import ANY_SIZE, decode_image, decode_mask, upright_of
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.extractors.turned import extract_upright
from mapless_server.method.features.views import Features, View
from mapless_server.settings import available_cores
from mapless_tools.output_files import whole_file
from mapless_tools.progress import Progress, tracked

from .pictures import Picture

VIEWS_IN_MEMORY = 64


class FeatureFolder:
    """The features of photographs in files of a folder, made by one extractor; those that are there are not made again.

    Keypoints are in pixels of the whole photograph, with its lens distortion. A file is named by the photograph's
    content and by what makes its features.
    """

    def __init__(self, folder: Path, extractor: FeatureExtractor, pictures: Sequence[Picture]) -> None:
        self._folder = folder
        self._extractor = extractor
        self._pictures = pictures
        self._files = {it.name: folder / f"{_digest(it, extractor.name)}.npz" for it in pictures}
        self.view = lru_cache(VIEWS_IN_MEMORY)(self._view)

    def file(self, name: str) -> Path:
        """The file of a photograph's features."""
        return self._files[name]

    def extract(self, progress: Progress) -> None:
        """Finds the features of those photographs that have none yet."""
        self._folder.mkdir(parents=True, exist_ok=True)
        missing = [it for it in self._pictures if not self.file(it.name).is_file()]
        with ThreadPoolExecutor(available_cores()) as pool:
            done = pool.map(self._extract, missing)
            try:
                for _ in tracked("features", done, len(missing), progress):
                    pass
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def colours(self, name: str) -> NDArray[np.uint8]:
        """Colours (N, 3), RGB, of a photograph at its keypoints."""
        with np.load(self.file(name)) as arrays:
            return np.asarray(arrays["colours"])

    def _view(self, name: str) -> View:
        with np.load(self.file(name)) as arrays:
            width, height = arrays["size"].tolist()
            features = Features(arrays["keypoints"], arrays["descriptors"], arrays["sizes_px"])
        return View(_plain_camera(width, height), features)

    def _extract(self, picture: Picture) -> None:
        data = picture.path.read_bytes()
        image = decode_image(data, ANY_SIZE)
        height, width = image.shape[:2]
        camera = _plain_camera(width, height)
        upright_deg, ignored = upright_of(data).clockwise_deg, None
        if picture.mask_path is not None:
            ignored = decode_mask(picture.mask_path.read_bytes(), (width, height), ANY_SIZE)
        view = extract_upright(self._extractor, image, camera, upright_deg, ignored=ignored)
        share = np.divide((width, height), (view.camera.width_px, view.camera.height_px))
        pixels = (view.features.pixels() + 0.5) * share - 0.5
        column, row = np.rint(pixels).astype(int).T
        with whole_file(self.file(picture.name)) as file, file.open("wb") as stream:
            np.savez(
                stream,
                keypoints=pixels.astype(np.float32),
                descriptors=view.features.descriptors,
                sizes_px=(view.features.sizes_px * share[0]).astype(np.float32),
                colours=image[row.clip(0, height - 1), column.clip(0, width - 1)],
                size=np.array([width, height]),
            )


def in_colmap_pixels(view: View) -> Array:
    """Keypoints (N, 2) where (0, 0) is the corner of the first pixel, not its centre."""
    return view.features.pixels() + 0.5


def _plain_camera(width: int, height: int) -> Camera:
    focal_px = float(max(width, height))
    return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)


def _digest(picture: Picture, extractor: str) -> str:
    mask = b"" if picture.mask_path is None else picture.mask_path.read_bytes()
    return hashlib.sha256(picture.path.read_bytes() + mask + f"{extractor} {__version__}".encode()).hexdigest()[:32]
