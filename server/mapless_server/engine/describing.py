"""What is found in a photograph before it is stored: local features of every tier, and the global descriptor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from mapless_server.images.decode import ImageLimits
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.turns import Turn
from mapless_server.method.views import View
from mapless_server.scenes.retrieval.descriptor import GlobalDescriptor, Vector

from .query import Photo
from .views import QueryViews


@dataclass(frozen=True, eq=False)
class Description:
    """What was found in a photograph.

    Attributes:
        views: camera and features by the extractor's name, the first tier's first; without the pixels.
        descriptors: global ones, by name.
    """

    views: Mapping[str, View]
    descriptors: Mapping[str, Vector]


class Describer:
    """Describes photographs; safe to use from several threads."""

    def __init__(
        self, extractors: Sequence[FeatureExtractor], descriptor: GlobalDescriptor, limits: ImageLimits
    ) -> None:
        """The first extractor's features are those that the descriptor is made of."""
        self._extractors = extractors
        self._descriptor = descriptor
        self._limits = limits

    def describe(self, photo: Photo, check: Callable[[], None]) -> Description:
        """Everything that is kept of a photograph; InvalidArgument if it is bad."""
        seen, turn = QueryViews(photo, self._limits), Turn(check)
        views = {it.name: seen.view(it, turn) for it in self._extractors}
        vector = self._descriptor.describe(views[self._extractors[0].name])
        # A batch is held in memory until it is stored, so without its pixels.
        without_pixels = {name: replace(view, photograph=None) for name, view in views.items()}
        return Description(without_pixels, {self._descriptor.name: vector})
