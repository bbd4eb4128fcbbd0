"""SIFT features: no weights, no torch; the default where there are no weights."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.bounds import check_bounds

from ..limits import MAX_KEYPOINTS, MAX_SIDE_PX, MULTIPLE_PX
from ..masks import are_usable, usable_pixels
from ..views import Ignored, View, reduce_image, view_of


@dataclass(frozen=True)
class SiftOptions:
    """Options of SIFT.

    Attributes:
        max_keypoints: the strongest are kept.
        max_side_px: longer images are reduced to it.
        contrast_threshold: half of OpenCV's default, for weakly textured walls; `max_keypoints` bounds the rest.
    """

    max_keypoints: int = MAX_KEYPOINTS
    max_side_px: int = MAX_SIDE_PX
    contrast_threshold: float = 0.02

    def __post_init__(self) -> None:
        check_bounds(self, "max_keypoints", at_least=1)
        check_bounds(self, "max_side_px", at_least=MULTIPLE_PX)
        check_bounds(self, "contrast_threshold", at_least=0)


@dataclass(frozen=True)
class SiftExtractor:
    """SIFT (Lowe 2004) by OpenCV; its descriptors are stored as histograms, see `Features`."""

    options: SiftOptions = field(default_factory=SiftOptions)

    @property
    def name(self) -> str:
        """Name of the extractor with its options, "sift-2048-1024px-0.02"."""
        options = self.options
        return f"sift-{options.max_keypoints}-{options.max_side_px}px-{options.contrast_threshold:g}"

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """See FeatureExtractor.extract."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        reduced, reduced_camera = reduce_image(grey, camera, self.options.max_side_px)
        # OpenCV's plain upscaling of the first octave shifts every keypoint by a quarter pixel.
        sift = cv2.SIFT.create(
            nfeatures=self.options.max_keypoints,
            contrastThreshold=self.options.contrast_threshold,
            enable_precise_upscale=True,
        )
        if ignored is None:
            found, raw = sift.detectAndCompute(reduced, None)
        else:
            usable = usable_pixels(ignored, reduced.shape[1], reduced.shape[0])
            found, raw = self._described(sift, reduced, usable)
        if not found:
            return view_of(reduced_camera, np.empty((0, 2)), np.empty((0, 128), np.uint8), np.empty(0, np.float32))
        # OpenCV keeps ties of the weakest keypoint, so it may return more than asked for.
        found, raw = found[: self.options.max_keypoints], raw[: self.options.max_keypoints]
        return view_of(
            reduced_camera,
            np.array([k.pt for k in found]),
            raw.astype(np.uint8),  # whole numbers
            np.array([k.size for k in found], np.float32),
        )

    def mirrored(self, view: View) -> View:
        """See Mirrors: no features are found again.

        A histogram has 4 rows and 4 columns of cells about the keypoint's orientation, with 8 directions each. Mirrored
        about the orientation, the rows and the directions are in reverse.
        """
        cells = view.features.descriptors.reshape(-1, 4, 4, 8)
        reverse = np.ascontiguousarray(cells[:, ::-1, :, -np.arange(8) % 8], np.uint8)
        return replace(view, features=replace(view.features, descriptors=reverse.reshape(-1, 128)))

    def _described(
        self, sift: cv2.SIFT, image: NDArray[np.uint8], usable: NDArray[np.bool_]
    ) -> tuple[Sequence[cv2.KeyPoint], NDArray[np.float32]]:
        """The strongest keypoints in usable pixels, and their descriptors.

        OpenCV applies a mask of its own to the strongest keypoints of the whole image, of which few may be left.
        """
        sift.setNFeatures(0)
        found = sift.detect(image, None)
        allowed = are_usable(usable, np.array([k.pt for k in found]))
        strengths = np.array([k.response for k in found])[allowed]
        strongest = np.sort(np.argsort(-strengths, kind="stable")[: self.options.max_keypoints])
        kept, descriptors = sift.compute(image, [found[i] for i in np.flatnonzero(allowed)[strongest]])
        return kept, np.asarray(descriptors, np.float32)
