"""Where a query's references come from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from mapless_server.method.features.extractors import FeatureExtractor
    from mapless_server.method.options import StageContext
    from mapless_server.scenes import Choice, Selection
    from mapless_server.scenes.later import Pending
    from mapless_server.scenes.library import Loaded
    from mapless_server.security import SceneKey

    from .photo_views import QueryViews


class ReferenceSource(Protocol):
    """Source of a query's references: `References`, or recorded or rendered ones."""

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
    ) -> Loaded:
        """Loads references of a scene, in the order given, with the scene as it was when they were read."""
        ...

    def contradiction(self, scene_key: SceneKey) -> str:
        """Returns the sentence that a scene contradicts itself, if that is known; else an empty one."""
        ...

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        selection: Selection,
        context: StageContext,
        extractor: FeatureExtractor | None = None,
    ) -> Choice:
        """Chooses references for a photograph, by what is made of this extractor's features if there is such."""
        ...

    def pending(self, scene_key: SceneKey) -> Sequence[Pending]:
        """Work that is left to the background in a scene."""
        ...

    def sample(self, scene_key: SceneKey, among: Sequence[str], count: int, context: StageContext) -> Sequence[str]:
        """Ids of so many references at most, evenly spread: of the scene's, or of these that it has."""
        ...

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Reports that a chosen reference is not used because it is damaged."""
        ...
