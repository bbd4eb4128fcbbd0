"""Why references of a scene do not agree with their poses, and how far away is what they show where they do.

References with exactly one pose that show different things are those of a tracker that had not begun. They explain
nothing else, so other mistakes are sought without them.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from mapless_server.errors import DataLoss
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.views import Matches, PosedView
from mapless_server.method.options import StageContext
from mapless_server.method.pairs.agreement import MAX_ERROR_PX
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.epipolar import SAME_PLACE
from mapless_server.method.pairs.readings.alignment import align_sessions
from mapless_server.method.pairs.readings.depth import median_depth
from mapless_server.method.pairs.readings.errors import MatchedPair, consistent
from mapless_server.method.pairs.readings.explanation import explain
from mapless_server.method.pairs.readings.repeats import same_poses
from mapless_server.method.pairs.stationary import stationary_matches
from mapless_server.security import SceneKey
from mapless_server.store.pairs import Pair

from .agreement import Agreement
from .indexes import SceneIndexes
from .library import ReferenceLibrary
from .repeats import same_pose_text
from .retrieval.index import Entries

EXPLAINED_PAIRS, MEASURED_PAIRS = 24, 12
"""Pairs from which a mistake is found, and those that agree, from which the depth is measured."""

NAMED = 3
"""References of a session that are named: more may be added, and belong to it."""


@dataclass(frozen=True)
class SamePose:
    """References, by their keys, with exactly one pose that show different things, and one sentence about them."""

    keys: frozenset[str]
    text: str


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
        return median_depth(*self._matched(scene_key, pairs, self._matcher.pairs.match))

    def _sessions(self, scene_key: SceneKey, groups: Sequence[Sequence[str]], pairs: Sequence[Pair]) -> str:
        group_of = {key: number for number, keys in enumerate(groups) for key in keys}
        between = [pair for pair in sorted(pairs) if {group_of.get(key) for key in pair} == {0, 1}]
        views, matched = self._matched(scene_key, spread(between, EXPLAINED_PAIRS), self._free_matches)
        id_of = self._ids(scene_key, {key for keys in groups for key in keys})
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

    def same_poses(self, scene_key: SceneKey, errors_px: Mapping[Pair, float]) -> list[SamePose]:
        """References with exactly one pose most of whose pairs do not agree with it."""
        entries = self._entries(scene_key)
        bad = [pair for pair, error_px in errors_px.items() if error_px > MAX_ERROR_PX]
        row_of = entries.rows_of_keys({key for pair in bad for key in pair})
        bad = [pair for pair in bad if set(pair) <= row_of.keys()]
        first, second = (entries.centres(np.array([row_of[pair[side]] for pair in bad], np.intp)) for side in (0, 1))
        at_one_place = np.flatnonzero((np.abs(first - second) < SAME_PLACE).all(axis=1)).tolist()
        keys = sorted({key for i in at_one_place for key in bad[i]}, key=lambda key: row_of[key])
        known = {key: entries.reference(row_of[key]) for key in keys}
        groups = same_poses({i: known[key][2] for i, key in enumerate(keys)})
        group_of = {keys[i]: number for number, indices in enumerate(groups) for i in indices}
        votes = [0] * len(groups)
        for (one, other), error_px in errors_px.items():
            number = group_of.get(one)
            if number is not None and number == group_of.get(other):
                votes[number] += 1 if error_px <= MAX_ERROR_PX else -1
        found = []
        for indices, vote in zip(groups, votes, strict=True):
            if vote < 0:
                ids = [known[keys[i]][0] for i in indices]
                text = same_pose_text("that show different things", ids, known[keys[indices[0]]][2])
                found.append(SamePose(frozenset(keys[i] for i in indices), text))
        return found

    def _entries(self, scene_key: SceneKey) -> Entries:
        return self._indexes.entries(scene_key, StageContext(self._check))

    def _ids(self, scene_key: SceneKey, keys: Collection[str]) -> dict[str, str]:
        """The ids of references by their keys, in the order in which they were added."""
        entries = self._entries(scene_key)
        return {key: entries.reference(row)[0] for key, row in entries.rows_of_keys(keys).items()}

    def _matched(
        self, scene_key: SceneKey, pairs: Sequence[Pair], match: Match
    ) -> tuple[dict[int, PosedView], list[MatchedPair]]:
        """The views of the pairs' references that exist, by an index, and the matches of pairs that have some."""
        id_of = self._ids(scene_key, {key for pair in pairs for key in pair})
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
        ratio = self._matcher.options.distinct_ratio
        matches = mutual_matches(first.view.features, second.view.features, ratio, True)
        fixed = stationary_matches(first, second, matches, self._matcher.pairs.stationary)
        return consistent(first.view, second.view, matches[~fixed])


def spread(pairs: Sequence[Pair], most: int) -> Sequence[Pair]:
    """At most so many of the pairs, evenly."""
    return pairs[:: -(-len(pairs) // most) or 1]
