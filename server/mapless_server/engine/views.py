"""A photograph to localize or to store, as each kind of features sees it."""

from __future__ import annotations

import hashlib
from dataclasses import replace

from mapless_server.images.decode import ImageLimits, decode_image
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.turns import Turn
from mapless_server.method.views import Photograph, View

from .query import Photo


class QueryViews:
    """Decodes a photograph once, and has it described once by each extractor, when first asked for."""

    def __init__(self, photo: Photo, limits: ImageLimits) -> None:
        self._photo = photo
        self._limits = limits
        self._photograph: Photograph | None = None
        self._views: dict[str, View] = {}

    def view(self, extractor: FeatureExtractor, turn: Turn) -> View:
        """The view with its photograph; the turn counts the time. InvalidArgument if the image is bad."""
        if extractor.name not in self._views:
            photograph = self._decoded(turn)
            with turn.stage("features"):
                view = extractor.extract(photograph.read(), photograph.camera)
            self._views[extractor.name] = replace(view, photograph=photograph)
        return self._views[extractor.name]

    def _decoded(self, turn: Turn) -> Photograph:
        if self._photograph is None:
            photo = self._photo
            with turn.stage("decode"):
                pixels = decode_image(photo.image, self._limits, photo.field)
                sha256 = hashlib.sha256(photo.image).hexdigest()
            self._photograph = Photograph(sha256, photo.camera, lambda: pixels)
        return self._photograph
