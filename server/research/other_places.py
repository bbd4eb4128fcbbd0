"""Many photographs of other places, asked of the method's own modules: how many are accepted.

`python -m research.other_places SCENES --json FILE`. Features are computed once a photograph, so that a query takes a
tenth of a second. The ladder has the attempts that need no server: those with other matches and other solvers, not
those with stronger features or a turned raster.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from mapless_server.method.judge.answer import Localization
from mapless_tools.evaluate.plan import evenly_spread
from mapless_tools.output_files import check_writable, markdown_table, write_json

from .described import Described, Pair, answered, read_place
from .places import Scenes

QUERIES = 2000
PHOTOGRAPHS, REFERENCES = 20, 10
"""Photographs of a scene that are described, and those of them that a query is given."""


def crossed(scenes: Scenes, count: int) -> list[tuple[str, str]]:
    """So many ordered pairs of scenes of different places, in steps of equal length over all pairs, again and again."""
    pairs = [(of, at) for of in scenes.names for at in scenes.others(of)]
    if not pairs:
        raise ValueError(f"{scenes.folder} has no two scenes of different places")
    rounds, rest = divmod(count, len(pairs))
    return pairs * rounds + [pairs[i * len(pairs) // rest] for i in range(rest)]


def _pairs(scenes: Scenes, count: int) -> Iterator[Pair]:
    @cache
    def place_of(name: str) -> Described:
        return read_place(scenes.folder / name, evenly_spread(range(len(scenes.dataset(name).frames)), PHOTOGRAPHS))

    taken = Counter[str]()
    for name, at in crossed(scenes, count):
        own, other = place_of(name), place_of(at)
        indices = sorted(own.views)
        index = indices[taken[name] % len(indices)]
        taken[name] += 1
        references = other.most_matching(own.views[index], sorted(other.views), REFERENCES)
        yield Pair(f"{name} {index} in {at}", REFERENCES, own.views[index], other.posed(references), None)


def main() -> None:
    """Asks and prints how often each outcome came; a folder or file that is wrong ends the program with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m research.other_places", description=__doc__)
    parser.add_argument("scenes", type=Path, help="folder of the scenes' folders")
    parser.add_argument("--json", type=Path, required=True, help="file for the outcomes")
    parser.add_argument("--queries", type=int, default=QUERIES, metavar="N", help=f"how many; default: {QUERIES}")
    arguments = parser.parse_args()
    rows = list[dict[str, object]]()
    try:
        check_writable(arguments.json)
        for measured in answered(_pairs(Scenes(arguments.scenes), arguments.queries)):
            outcome, name = measured.answer.outcome, measured.pair.title
            if isinstance(outcome, Localization):
                rows.append({"name": name, "outcome": "localized", "trust": outcome.trust})
            else:
                rows.append({"name": name, "outcome": outcome.reason.value})
        write_json(arguments.json, {"answers": rows})
    except (OSError, ValueError) as error:
        parser.error(str(error))
    print("\n".join(markdown_table("outcome | queries", Counter(it["outcome"] for it in rows).most_common())))


if __name__ == "__main__":
    main()
