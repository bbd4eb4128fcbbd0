"""The seam: an extractor is a name and one method."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera

from ..views import View


class FeatureExtractor(Protocol):
    """Finds local features.

    Attributes:
        name: identifies the extractor and everything that changes its output; the key of stored features.
    """

    @property
    def name(self) -> str:
        """See the class."""
        ...

    def extract(self, image: NDArray[np.uint8], camera: Camera) -> View:
        """The view of a photograph.

        Args:
            image: (H, W, 3) uint8, RGB, as stored in the file.
            camera: its camera, of the same size.

        Returns:
            The view, possibly with no keypoints at all (a blank wall); that is for the caller to judge.
        """
        ...
