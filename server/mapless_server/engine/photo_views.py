"""A photograph decoded once, and described once with each extractor in each raster, when first needed."""

from __future__ import annotations

import hashlib
import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.images import ImageLimits, decode_image, upright_of
from mapless_server.method.features.extractors import FeatureExtractor, Mirrors
from mapless_server.method.features.extractors.turned import extract_upright
from mapless_server.method.features.views import Photograph, View, reduce_image
from mapless_server.method.options import StageContext
from mapless_server.method.structure.measured_depth import MeasuredDepth

from .query import Photo


@dataclass(frozen=True)
class RasterForm:
    """The raster in which features of a photograph are found.

    Attributes:
        angles_deg: the raster that is upright by the photograph's EXIF is turned clockwise by each of these; pixels of
            the features are of the photograph as it is stored. Empty if it is not turned any further.
        max_pixels: about so many at most; None for all.
        is_mirrored: whether descriptors are those of the mirror image: such a view can be matched, but has no pose.
    """

    angles_deg: tuple[float, ...] = ()
    max_pixels: int | None = None
    is_mirrored: bool = False


class _Decoded:
    """A photograph that is decoded when it is first needed, and its views so far, by extractor and form."""

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self.views: dict[tuple[str, RasterForm], View] = {}
        self._photo, self._limits = photo, limits
        self._photograph: Photograph | None = None
        self._depth: NDArray[np.float32] | None = None
        self._measured: dict[Camera, MeasuredDepth] = {}

    @cached_property
    def upright_deg(self) -> float:
        """By how much the raster has to be turned clockwise to be upright: by its EXIF, or else by the photo."""
        return upright_of(self._photo.image).clockwise_deg or self._photo.upright_deg

    def read(self, context: StageContext) -> Photograph:
        """The photograph; InvalidArgument if it is bad."""
        if self._photograph is None:
            photo = self._photo
            with context.stage("decode"):
                pixels = decode_image(photo.image, self._limits, photo.field)
                ignored = photo.read_ignored(self._limits)
            identify = lambda: hashlib.sha256(photo.image).hexdigest()  # noqa: E731
            read_depth = None if photo.depth is None else self._read_depth
            self._photograph = Photograph(
                identify, photo.camera, lambda: pixels, lambda: ignored, read_depth=read_depth
            )
        return self._photograph

    def _read_depth(self, camera: Camera) -> MeasuredDepth:
        assert self._photo.depth is not None
        if self._depth is None:
            self._depth = self._photo.read_depth(self._limits)
        if camera not in self._measured:
            self._measured[camera] = MeasuredDepth.of(self._photo.depth, self._depth, camera)
        return self._measured[camera]


class QueryViews:
    """Decodes a photograph once, and describes it once with each extractor in each form, when first needed.

    Attributes:
        form: the raster in which its features are found.
    """

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self.form = RasterForm()
        self._limits = limits
        self._decoded = _Decoded(photo, limits)

    def in_form(self, form: RasterForm) -> QueryViews:
        """The same photograph, decoded once, whose features are found in another raster."""
        views = copy(self)
        views.form = form
        return views

    def of(self, photo: Photo) -> QueryViews:
        """The views of another photograph in the same form."""
        return QueryViews(photo, self._limits).in_form(self.form)

    def view(self, extractor: FeatureExtractor, context: StageContext) -> View:
        """The photograph's view with this extractor's features; InvalidArgument if the image is bad."""
        known, key = self._decoded.views, (extractor.name, self.form)
        if key not in known and self.form.is_mirrored:
            assert isinstance(extractor, Mirrors)
            known[key] = extractor.mirrored(
                self.in_form(replace(self.form, is_mirrored=False)).view(extractor, context)
            )
        if key not in known:
            photograph = self._decoded.read(context)
            with context.stage("features"):
                known[key] = replace(self._extracted(extractor, photograph), photograph=photograph)
        return known[key]

    def _extracted(self, extractor: FeatureExtractor, photograph: Photograph) -> View:
        pixels, camera, ignored = photograph.read(), photograph.camera, photograph.read_ignored()
        if (most := self.form.max_pixels) is not None:
            share = min(1.0, math.sqrt(most / (camera.width_px * camera.height_px)))
            pixels, camera = reduce_image(pixels, camera, round(share * max(camera.width_px, camera.height_px)))
        upright_deg = self._decoded.upright_deg
        if not upright_deg and not self.form.angles_deg:
            return extractor.extract(pixels, camera, ignored)
        return extract_upright(extractor, pixels, camera, upright_deg, self.form.angles_deg, ignored)

    def ignored_share(self, context: StageContext) -> float:
        """Share of the pixels that its mask ignores, 0 to 1; InvalidArgument if image or mask is bad."""
        return self._decoded.read(context).ignored_share
