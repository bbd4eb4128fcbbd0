"""A photograph of a query or a new reference: decoded once, described by each extractor when first needed."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mapless_server.images import ImageLimits, decode_image, decode_mask
from mapless_server.method.features.extractors.turned import extract_turned
from mapless_server.method.features.views import Photograph, reduce_image

if TYPE_CHECKING:  # services need not load what computes
    from mapless.geometry import Camera
    from mapless_server.method.features.extractors import FeatureExtractor
    from mapless_server.method.features.views import Ignored, View
    from mapless_server.method.options import StageContext
    from mapless_server.scenes import Vector


@dataclass(frozen=True, eq=False)
class Photo:
    """An encoded image and its camera, perhaps with a mask of ignored pixels, a PNG; empty for none.

    `field` is the image's path in the request, for error messages.
    """

    image: bytes
    camera: Camera
    field: str
    mask: bytes = b""

    @property
    def size_bytes(self) -> int:
        """Size of the encoded image and mask."""
        return len(self.image) + len(self.mask)

    def read_ignored(self, limits: ImageLimits) -> Ignored | None:
        """Decodes the mask; None if there is none or it ignores nothing. InvalidArgument if it is bad."""
        if not self.mask:
            return None
        size = self.camera.width_px, self.camera.height_px
        return decode_mask(self.mask, size, limits, self.mask_field)

    @property
    def mask_field(self) -> str:
        """Path of the mask in the request."""
        return self.field.removesuffix("image") + "mask"


@dataclass(frozen=True, eq=False)
class Description:
    """What the store keeps of a photograph besides the photograph itself.

    Views, without pixels, are by the extractor's name, the first tier's first; descriptors by their own. The mask
    ignores a share of the pixels, 0 to 1.
    """

    views: Mapping[str, View]
    descriptors: Mapping[str, Vector]
    ignored_share: float = 0.0


class QueryViews:
    """Decodes a photograph once, and describes it once with each extractor, when first needed.

    Attributes:
        quarter_turns: clockwise, of the raster in which its features are found.
        is_mirrored: whether they are found in the raster exchanged left and right, and their pixels are of that: such a
            view can be matched, but has no pose.
    """

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self._photo = photo
        self._limits = limits
        self._photograph: Photograph | None = None
        self._views: dict[str, View] = {}
        self._max_pixels: int | None = None
        self.quarter_turns, self.is_mirrored = 0, False
        self._not_turned: QueryViews | None = None

    def view(self, extractor: FeatureExtractor, context: StageContext) -> View:
        """The photograph's view with this extractor's features; InvalidArgument if the image is bad."""
        if extractor.name not in self._views:
            photograph = self._decoded(context)
            with context.stage("features"):
                pixels, camera = photograph.read(), photograph.camera
                if self._max_pixels is not None:
                    share = min(1.0, math.sqrt(self._max_pixels / (camera.width_px * camera.height_px)))
                    pixels, camera = reduce_image(pixels, camera, round(share * max(camera.width_px, camera.height_px)))
                ignored = photograph.read_ignored()
                if self.quarter_turns:
                    view = extract_turned(extractor, pixels, camera, self.quarter_turns, ignored)
                elif self.is_mirrored:
                    mirrored = None if ignored is None else ignored[:, ::-1]
                    view = extractor.extract(np.ascontiguousarray(pixels[:, ::-1]), camera, mirrored)
                else:
                    view = extractor.extract(pixels, camera, ignored)
            self._views[extractor.name] = replace(view, photograph=photograph)
        return self._views[extractor.name]

    def reduced(self, max_pixels: int, context: StageContext) -> QueryViews:
        """The same photograph, decoded once, whose features are found in a reduced image with about so many pixels."""
        views = QueryViews(self._photo, self._limits)
        views._photograph, views._max_pixels = self._decoded(context), max_pixels
        return views

    def turned(self, quarter_turns: int, context: StageContext) -> QueryViews:
        """The same photograph, decoded once, whose features are found in its raster turned clockwise.

        Their pixels are of the photograph as it is, and so is its pose.
        """
        views = QueryViews(self._photo, self._limits)
        views._photograph, views.quarter_turns = self._decoded(context), quarter_turns
        views._not_turned = self.not_turned
        return views

    def mirrored(self, context: StageContext) -> QueryViews:
        """The same photograph, decoded once, whose features are found in its raster exchanged left and right."""
        views = QueryViews(self._photo, self._limits)
        views._photograph, views.is_mirrored = self._decoded(context), True
        return views

    def ignored_share(self, context: StageContext) -> float:
        """Share of the pixels that its mask ignores, 0 to 1; InvalidArgument if image or mask is bad."""
        return self._decoded(context).ignored_share

    @property
    def not_turned(self) -> QueryViews:
        """The same photograph, whose features are found in its raster as it is."""
        return self._not_turned or self

    def _decoded(self, context: StageContext) -> Photograph:
        if self._photograph is None:
            photo = self._photo
            with context.stage("decode"):
                pixels = decode_image(photo.image, self._limits, photo.field)
                ignored = photo.read_ignored(self._limits)
            identify = lambda: hashlib.sha256(photo.image).hexdigest()  # noqa: E731
            self._photograph = Photograph(identify, photo.camera, lambda: pixels, lambda: ignored)
        return self._photograph
