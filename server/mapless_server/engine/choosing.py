"""Choosing references for a photograph: by its global descriptor, among all of a scene or those that are named."""

from __future__ import annotations

from collections.abc import Sequence

from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.turns import Turn
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.retrieval.chosen import Choice
from mapless_server.scenes.retrieval.descriptor import GlobalDescriptor
from mapless_server.scenes.retrieval.narrowing import Narrowing
from mapless_server.scenes.retrieval.ranking import RankOptions, rank_references
from mapless_server.security.tenancy import SceneKey, scene_id_of

from .views import QueryViews


class ReferenceChooser:
    """Chooses references; safe to use from several threads.

    Attributes:
        indexes: of the scenes.
    """

    def __init__(self, indexes: SceneIndexes, descriptor: GlobalDescriptor, extractor: FeatureExtractor) -> None:
        """`indexes` hold the descriptors; `extractor` finds the features that they are made of.

        Raises:
            ValueError: it is made of others.
        """
        if descriptor.extractor not in (None, extractor.name):
            raise ValueError(f"{descriptor.name} is made of {descriptor.extractor}, not of {extractor.name}")
        self.indexes = indexes
        self._descriptor = descriptor
        self._extractor = extractor

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        count: int,
        narrowing: Narrowing,
        among: Sequence[str],
        turn: Turn,
        options: RankOptions | None = None,
    ) -> Choice:
        """At most `count` references for a photograph.

        Args:
            scene_key: the scene.
            views: the photograph.
            count: how many.
            narrowing: what is known of where it was taken.
            among: ids of those that come into question; empty for all.
            turn: counts the time.
            options: of the ranking.

        Raises:
            NotFound: there is no such scene (field "scene") or reference (field "references[i]").
            DataLoss: one that is named is damaged (field "references[i]").
            InvalidArgument: the image is bad.
        """
        # The scene comes first: a name that is wrong is found out before the photograph is described.
        entries = self.indexes.entries(scene_key, turn)
        for index, reference_id in enumerate(among):
            if reference_id not in entries:
                if self.indexes.is_damaged(scene_key, reference_id):
                    message = f"reference {reference_id!r} is damaged in the store: delete it and add it again"
                    raise DataLoss(message, field=f"references[{index}]")
                message = f"there is no reference {reference_id!r} in scene {scene_id_of(scene_key)!r}"
                raise NotFound(message, field=f"references[{index}]")
        if not len(entries):
            return Choice((), self._descriptor.name, entries.generation)
        view = views.view(self._extractor, turn)
        with turn.stage("retrieval"):
            vector = self._descriptor.describe(view)
            ranked = rank_references(entries, vector, count, narrowing, frozenset(among) if among else None, options)
        return Choice(tuple(ranked), self._descriptor.name, entries.generation)

    def tell_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Logs, once while the scene is held, that a reference that was chosen is not used because it is damaged."""
        self.indexes.tell_damaged(scene_key, reference_id, error)
