"""Measures what the depth of the photograph that is localized is worth, on folders with depth (`cameras.json`).

    python -m research.query_depth FOLDER... [--features auto] [--pairs 25] [--queries 12] [--json FILE]

Each photograph is asked with its depth and without, one after the other. One reference, of whose depth half is visible
in the photograph: with its depth, and without. Several: 2, 3 and 5 references, evenly spread, without their depth and
with it. An answer is wrong if it is off by more than 5 % of the median depth. See `depth_places` for sensors and poses.
"""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from .depth_places import CACHE, DepthPlace
from .depth_tables import WRONG_SHARE, Outcome, ratio, written

COUNTS = (2, 3, 5)


def main() -> None:
    """Prints the table as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--features", default="auto")
    parser.add_argument("--pairs", type=int, default=25, help="of one reference and a photograph, a folder")
    parser.add_argument("--queries", type=int, default=12, help="photographs for several references, a folder")
    parser.add_argument("--counts", type=int, nargs="*", default=list(COUNTS))
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--json", type=Path, help="file to which each outcome is appended")
    arguments = parser.parse_args()
    found = list[Outcome]()
    for folder in arguments.folders:
        with closing(DepthPlace(folder, arguments.features, arguments.cache)) as place:
            for outcome in outcomes(place, arguments.pairs, arguments.queries, arguments.counts):
                found.append(written(outcome, arguments.json))
    print(*rows(found), sep="\n")


def outcomes(place: DepthPlace, pairs: int, queries: int, counts: Sequence[int]) -> Iterator[Outcome]:
    """Those of one reference, and of several, each with the photograph's depth and without."""
    for i, j in place.depths.pairs(pairs):
        yield from _both("one", place, [i], j)
    count = len(place.frames)
    for few in counts:
        references = np.unique(np.linspace(0, count - 1, few).round().astype(int)).tolist()
        others = [it for it in range(count) if it not in references]
        for j in np.unique(np.linspace(0, len(others) - 1, queries).astype(int)):
            yield from _both("several", place, references, others[j])


def _both(kind: str, place: DepthPlace, references: Sequence[int], j: int) -> Iterator[Outcome]:
    for has_depth in (False, True):
        for photo_has_depth in (False, True):
            yield place.outcome(kind, references, place.frames[j], has_depth, photo_has_depth=photo_has_depth)


def rows(found: Sequence[Outcome]) -> Iterator[str]:
    """The table, with intervals of 95 %; errors and times are those of photographs localized both ways."""
    yield (
        "| place | references | their depth | localized without | with | wrong | median error without | with | in 68 % "
        "| in 95 % | processor time of the depth |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|"
    keys = dict.fromkeys((it.place, it.references, it.has_depth) for it in found)
    for key in [*keys, *((("all", n, has)) for n, has in dict.fromkeys(it[1:] for it in keys))]:
        its = [it for it in found if (it.references, it.has_depth) == key[1:] and key[0] in (it.place, "all")]
        without, with_depth = ([it for it in its if it.photo_has_depth is has] for has in (False, True))
        both = [(a, b) for a, b in zip(without, with_depth, strict=True) if a.is_localized and b.is_localized]
        right = [it for it in with_depth if it.is_localized]
        wrong = [sum(it.is_localized and it.share > WRONG_SHARE for it in side) for side in (without, with_depth)]
        errors = [100 * np.median([side.share for side in sides]) for sides in zip(*both, strict=True)]
        added = [1000 * (b.processor_s - a.processor_s) for a, b in both]
        cells = [
            key[0],
            str(key[1]),
            "yes" if key[2] else "no",
            *(f"{sum(it.is_localized for it in side)} of {len(side)}" for side in (without, with_depth)),
            f"{wrong[0]}, {wrong[1]}",
            *([f"{it:.2f} %" for it in errors] or ["", ""]),
            ratio(sum((it.of_68 or 0) <= 1 for it in right), len(right)) if right else "",
            ratio(sum((it.of_95 or 0) <= 1 for it in right), len(right)) if right else "",
            f"{np.median(added):.0f} ms" if added else "",
        ]
        yield f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
