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


@dataclass(frozen=True)
class RasterForm:
    """The raster in which features of a photograph are found.

    Attributes:
        quarter_turns: clockwise, of the raster; pixels of the features are of the photograph as it is.
        max_pixels: about so many at most; None for all.
        is_mirrored: whether it is exchanged left and right, and pixels of the features are of that: such a view can be
            matched, but has no pose.
    """

    quarter_turns: int = 0
    max_pixels: int | None = None
    is_mirrored: bool = False


class _Decoded:
    """A photograph that is decoded when it is first needed, and its views so far, by extractor and form."""

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self.views: dict[tuple[str, RasterForm], View] = {}
        self._photo, self._limits = photo, limits
        self._photograph: Photograph | None = None

    def read(self, context: StageContext) -> Photograph:
        """The photograph; InvalidArgument if it is bad."""
        if self._photograph is None:
            photo = self._photo
            with context.stage("decode"):
                pixels = decode_image(photo.image, self._limits, photo.field)
                ignored = photo.read_ignored(self._limits)
            identify = lambda: hashlib.sha256(photo.image).hexdigest()  # noqa: E731
            self._photograph = Photograph(identify, photo.camera, lambda: pixels, lambda: ignored)
        return self._photograph


class QueryViews:
    """Decodes a photograph once, and describes it once with each extractor in each form, when first needed.

    Attributes:
        form: the raster in which its features are found.
    """

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self.form = RasterForm()
        self._decoded = _Decoded(photo, limits)

    def in_form(self, form: RasterForm) -> QueryViews:
        """The same photograph, decoded once, whose features are found in another raster."""
        views = object.__new__(QueryViews)
        views.form, views._decoded = form, self._decoded
        return views

    def view(self, extractor: FeatureExtractor, context: StageContext) -> View:
        """The photograph's view with this extractor's features; InvalidArgument if the image is bad."""
        known, key = self._decoded.views, (extractor.name, self.form)
        if key not in known:
            photograph = self._decoded.read(context)
            with context.stage("features"):
                known[key] = replace(_extracted(extractor, photograph, self.form), photograph=photograph)
        return known[key]

    def ignored_share(self, context: StageContext) -> float:
        """Share of the pixels that its mask ignores, 0 to 1; InvalidArgument if image or mask is bad."""
        return self._decoded.read(context).ignored_share


def _extracted(extractor: FeatureExtractor, photograph: Photograph, form: RasterForm) -> View:
    pixels, camera, ignored = photograph.read(), photograph.camera, photograph.read_ignored()
    if form.max_pixels is not None:
        share = min(1.0, math.sqrt(form.max_pixels / (camera.width_px * camera.height_px)))
        pixels, camera = reduce_image(pixels, camera, round(share * max(camera.width_px, camera.height_px)))
    if form.is_mirrored:
        mirrored = None if ignored is None else ignored[:, ::-1]
        return extractor.extract(np.ascontiguousarray(pixels[:, ::-1]), camera, mirrored)
    if form.quarter_turns:
        return extract_turned(extractor, pixels, camera, form.quarter_turns, ignored)
    return extractor.extract(pixels, camera, ignored)
