"""Why references of a scene do not agree with their poses, and how far away is what they show where they do."""

from collections.abc import Callable, Sequence
from contextlib import suppress

from mapless_server.errors import DataLoss
from mapless_server.method.correspond import Matcher
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.nearest import mutual_matches
from mapless_server.method.options import StageContext
from mapless_server.method.readings import MatchedPair, align_sessions, consistent, explain, median_depth
from mapless_server.method.stationary import stationary_matches
from mapless_server.method.views import Matches, PosedView
from mapless_server.security import SceneKey
from mapless_server.store.pairs import Pair

from .agreement import Agreement
from .indexes import SceneIndexes
from .library import ReferenceLibrary
from .retrieval.index import Entries

EXPLAINED_PAIRS, MEASURED_PAIRS = 24, 12
"""Pairs from which a mistake is found, and those that agree, from which the depth is measured."""

NAMED = 3
"""References of a session that are named: more may be added, and belong to it."""

Match = Callable[[PosedView, PosedView], Matches]


class SceneExplainer:
    """Loads and matches some of a scene's pairs to explain them; thread-safe, takes a second or two."""

    def __init__(
        self,
        indexes: SceneIndexes,
        library: ReferenceLibrary,
        extractor: FeatureExtractor,
        matcher: Matcher,
        check: Callable[[], None],
    ) -> None:
        """`check` raises if the work is to end."""
        self._indexes, self._library = indexes, library
        self._extractor, self._matcher = extractor, matcher
        self._check = check

    def explanation(self, scene_key: SceneKey, found: Agreement, pairs: Sequence[Pair]) -> str:
        """The similarity between two sessions, or the mistake whose correction makes the poses fit; empty if unknown.

        Args:
            scene_key: a scene that contradicts itself.
            found: its agreement.
            pairs: its pairs that can be compared with their poses.
        """
        if found.groups:
            return self._sessions(scene_key, found.groups, pairs)
        views, matched = self._matched(scene_key, spread(sorted(pairs), EXPLAINED_PAIRS), self._free_matches)
        return explain(views, matched).text

    def median_depth(self, scene_key: SceneKey, agreeing: Sequence[Pair]) -> float | None:
        """Median depth of what pairs that agree show, in the scene's unit; None if they show too few points."""
        pairs = spread(sorted(agreeing), MEASURED_PAIRS)
        return median_depth(*self._matched(scene_key, pairs, self._matcher.match_references))

    def _sessions(self, scene_key: SceneKey, groups: Sequence[Sequence[str]], pairs: Sequence[Pair]) -> str:
        group_of = {key: number for number, keys in enumerate(groups) for key in keys}
        between = [pair for pair in sorted(pairs) if {group_of.get(key) for key in pair} == {0, 1}]
        views, matched = self._matched(scene_key, spread(between, EXPLAINED_PAIRS), self._free_matches)
        id_of = self._ids(scene_key)
        added = {key: row for row, key in enumerate(id_of)}
        first, second = sorted(groups, key=lambda keys: min(added.get(key, len(added)) for key in keys))
        of_keys = [[i for i, view in views.items() if view.key in keys] for keys in (first, second)]
        found = align_sessions(views, matched, *of_keys)
        if found is None:
            return ""
        names = sorted((key for key in second if key in added), key=lambda key: added[key])[:NAMED]
        return (
            f"two sessions, each in a world of its own: that of {', '.join(id_of[key] for key in names)} would fit the "
            f"other with {found.text}"
        )

    def _ids(self, scene_key: SceneKey) -> dict[str, str]:
        """The ids of a scene's references by their keys, in the order in which they were added."""
        entries: Entries = self._indexes.entries(scene_key, StageContext(self._check))
        return {key: reference_id for reference_id, key, _ in map(entries.reference, map(int, entries.rows()))}

    def _matched(
        self, scene_key: SceneKey, pairs: Sequence[Pair], match: Match
    ) -> tuple[dict[int, PosedView], list[MatchedPair]]:
        """The views of the pairs' references that exist, by an index, and the matches of pairs that have some."""
        id_of = self._ids(scene_key)
        pairs = [pair for pair in pairs if set(pair) <= id_of.keys()]
        keys = sorted({key for pair in pairs for key in pair})
        loaded: dict[str, PosedView] = {}
        with suppress(DataLoss):
            loaded = {it.key: it for it in self.load(scene_key, [id_of[key] for key in keys])}
        indices = {key: i for i, key in enumerate(keys)}
        matched = []
        for first, second in pairs:
            self._check()
            if {first, second} <= loaded.keys():
                matches = match(loaded[first], loaded[second])
                matched.append(MatchedPair((indices[first], indices[second]), matches))
        return {indices[key]: view for key, view in loaded.items()}, [it for it in matched if len(it.matches)]

    def load(self, scene_key: SceneKey, reference_ids: Sequence[str]) -> tuple[PosedView, ...]:
        """Loads those of the references that exist and are not damaged, in order."""
        context = StageContext(self._check)
        return self._indexes.load_existing(self._library, scene_key, reference_ids, self._extractor, context)

    def _free_matches(self, first: PosedView, second: PosedView) -> Matches:
        """Matches of what is not fixed to a camera, that one fundamental matrix explains; the poses take no part."""
        matches = mutual_matches(first.view.features, second.view.features, self._matcher.options.distinct_ratio, True)
        fixed = stationary_matches(first, second, matches, self._matcher.stationary)
        return consistent(first.view, second.view, matches[~fixed])


def spread(pairs: Sequence[Pair], most: int) -> Sequence[Pair]:
    """At most so many of the pairs, evenly."""
    return pairs[:: -(-len(pairs) // most) or 1]
