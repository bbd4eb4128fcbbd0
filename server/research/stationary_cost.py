"""Processor time of a query for what is fixed to the camera: `python -m research.stationary_cost`.

The demo's room, ten references and SIFT, without and with a badge on all photographs. Matches, which are made anyway,
are not counted. It prints medians, milliseconds: of a query whose references were asked before, of the first one that
asks them, and of a pair of references.
"""

import time
from collections.abc import Callable, Mapping
from itertools import combinations
from statistics import median

from mapless_server.cache import LruCache
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.judge.answer import Answer
from mapless_server.method.judge.references import unmoved_failure
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.correspond import references_without_fixed, without_fixed
from mapless_server.method.pairs.pair import Matching, PairKey, PairMatches
from mapless_server.method.pairs.stationary import StationaryOptions, stationary_matches
from mapless_server.method.pipeline import Pipeline

from .evidence.overlays import OVERLAYS, Overlay
from .evidence.stationary import draw, scene_of_room

REPEATS = 50
OPTIONS = StationaryOptions()


def cost_ms(work: Callable[[], object]) -> float:
    """Median processor time of a call."""
    spent = []
    for _ in range(REPEATS):
        begin_s = time.thread_time()
        work()
        spent.append(1e3 * (time.thread_time() - begin_s))
    return median(spent)


def measured(overlay: Overlay) -> Mapping[str, float]:
    """Costs in milliseconds, by what is done."""
    drawn = draw(scene_of_room(), overlay, SiftExtractor())
    references, query = drawn.references[:10], drawn.queries[0].view
    pipeline = Pipeline()
    ratio = pipeline.matcher.options.query_ratio
    every = dict.fromkeys(combinations(range(len(references)), 2))
    matches = {
        (i, j): mutual_matches(references[i].view.features, references[j].view.features, 0.9, True) for i, j in every
    }
    pairs = {(i, j): PairMatches.of(references[i], references[j], it, OPTIONS) for (i, j), it in matches.items()}
    keys = frozenset(PairKey(references[i].key, references[j].key, Matching.STRICT) for i, j in every)
    of_query = [mutual_matches(query.features, it.view.features, ratio, True) for it in references]
    cache: LruCache[object] = LruCache(2**25)

    def filtered() -> None:
        fixed = references_without_fixed(references, pairs, keys, OPTIONS, cache)
        without_fixed(query, references, pairs, of_query, fixed)

    def first() -> None:
        cache.clear()
        filtered()

    answer: Answer = localize(query, references, pipeline, LocalizeOptions())
    support = answer.support
    assert isinstance(support, PosedSupport)
    return {
        "evidence of a query": cost_ms(lambda: unmoved_failure(support, 12.0, OPTIONS)),
        "the first query of these references": cost_ms(first),
        "another query of them": cost_ms(filtered),
        "a pair of references": cost_ms(
            lambda: stationary_matches(references[0], references[1], matches[0, 1], OPTIONS)
        ),
    }


if __name__ == "__main__":
    for name, overlay in {
        "nothing": lambda image, number: (image, image[..., 0] < 0),
        "badge": OVERLAYS["badge"],
    }.items():
        for what, spent_ms in measured(overlay).items():
            print(f"{name}: {what}: {spent_ms:.3f} ms")
