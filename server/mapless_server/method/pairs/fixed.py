"""The matches of a query's references without keypoints that are fixed to their cameras, see `stationary`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless_server.cache import LruCache

from ..features.tracks import keypoint_offsets
from ..features.views import Matches, PosedView, View
from .pair import PairKey, PairMatches
from .stationary import IgnoredKeypoints, StationaryOptions, without_ignored


@dataclass(frozen=True, eq=False)
class ReferencesWithoutFixed:
    """References, in whatever order, without what is fixed to their cameras.

    Attributes:
        ignored: parts of the images; false if nothing is fixed.
        of_reference: mask (N,) of the ignored keypoints, by the reference's key.
        pairs: the agreeing matches of pairs without ignored keypoints, by the keys of both references.
    """

    ignored: IgnoredKeypoints
    of_reference: Mapping[str, NDArray[np.bool_]]
    pairs: Mapping[tuple[str, str], Matches]

    @classmethod
    def of(
        cls,
        references: Sequence[PosedView],
        pairs: Mapping[tuple[int, int], PairMatches],
        options: StationaryOptions,
    ) -> "ReferencesWithoutFixed":
        """Finds it by the matches of the pairs, by the references' indices."""
        ignored = IgnoredKeypoints(references, {pair: it.stationary for pair, it in pairs.items()}, options)
        if not ignored:
            return cls(ignored, {}, {})
        masks = [ignored.of(it.view) for it in references]
        # All pairs at once, which takes a fraction of the time.
        counts = [len(it.agreeing) for it in pairs.values()]
        matches = np.concatenate([it.agreeing for it in pairs.values()])
        begin = np.repeat(keypoint_offsets(references)[np.array(list(pairs))], counts, axis=0)
        kept = ~np.concatenate(masks)[matches + begin].any(axis=1)
        ends = np.concatenate([[0], np.cumsum(kept)])[np.cumsum(counts)]
        names = [(references[i].key, references[j].key) for i, j in pairs]
        of_pairs = zip(names, np.split(matches[kept], ends[:-1]), strict=True)
        return cls(ignored, {it.key: mask for it, mask in zip(references, masks, strict=True)}, dict(of_pairs))

    @property
    def size_bytes(self) -> int:
        """Memory of the arrays, bytes; at least one."""
        arrays = [*self.of_reference.values(), *self.pairs.values()]
        return 1 + self.ignored.size_bytes + sum(it.nbytes for it in arrays)

    def pair(self, first: PosedView, second: PosedView) -> Matches:
        """The matches of two of the references, in this order."""
        found = self.pairs.get((first.key, second.key))
        return self.pairs[second.key, first.key][:, ::-1] if found is None else found


def references_without_fixed(
    references: Sequence[PosedView],
    pairs: Mapping[tuple[int, int], PairMatches],
    keys: frozenset[PairKey],
    options: StationaryOptions,
    cache: LruCache[object],
) -> ReferencesWithoutFixed:
    """Finds what is fixed to the cameras of references, by the matches of their pairs.

    The pairs are given by the references' indices; their keys determine their matches, and with them the cached result.
    """
    key = tuple(sorted(it.key for it in references)), keys, options
    found = cache.get(key)
    if not isinstance(found, ReferencesWithoutFixed):
        found = ReferencesWithoutFixed.of(references, pairs, options)
        cache.put(key, found, found.size_bytes)
    return found


def without_fixed(
    query: View,
    references: Sequence[PosedView],
    pairs: Mapping[tuple[int, int], PairMatches],
    query_matches: Sequence[Matches],
    fixed: ReferencesWithoutFixed,
) -> tuple[dict[tuple[int, int], Matches], tuple[Matches, ...], int]:
    """The matches of pairs, and of a query with each reference, without keypoints that are fixed to the camera.

    The third result is the number of the query's keypoints whose matches are left out.
    """
    of_pairs = {(i, j): fixed.pair(references[i], references[j]) for i, j in pairs}
    of_query = fixed.ignored.of(query)
    kept = tuple(
        without_ignored(it, of_query, fixed.of_reference[reference.key])
        for it, reference in zip(query_matches, references, strict=True)
    )
    before, after = (len(np.unique(np.concatenate(it)[:, 0])) for it in (query_matches, kept))
    return of_pairs, kept, before - after
