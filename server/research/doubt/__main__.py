"""Asks the photographs, and prints what they cost and which of them are answered; see the package."""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from mapless_tools.output_files import check_writable, write_json
from research.contradictions.asking import Row
from research.places import Scenes

from .cases import (
    ANGLES_DEG,
    CROSSED_REFERENCES,
    EXPENSIVE_S,
    LIST,
    ORIENTATIONS,
    Asked,
    candidates,
    doubtful,
    held_photographs,
    other_places,
    turned_photographs,
    write_list,
)
from .serving import answers
from .tables import by, by_turn

WHAT = ("other-place", "doubtful", "turned", "held")


def main() -> None:
    """Asks and prints; a folder or file that is wrong ends the program with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m research.doubt", description=__doc__)
    parser.add_argument("what", choices=WHAT)
    parser.add_argument("scenes", type=Path, nargs="?", help="folder of the scenes' folders")
    parser.add_argument("--json", type=Path, required=True, help="file for the answers")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th photograph; default: all")
    parser.add_argument("--store", type=Path, help="folder of a store that remains, for later runs")
    parser.add_argument("--list", action="store_true", help=f"doubtful: all candidates; writes {LIST.name}")
    count = f"other-place: references of each place; default: {CROSSED_REFERENCES}"
    parser.add_argument("--references", type=int, default=CROSSED_REFERENCES, metavar="N", help=count)
    parser.add_argument("--print", action="store_true", help="print the table of an existing file, and ask nothing")
    arguments = parser.parse_args()
    for option, bound in (("every", 1), ("references", 2)):
        if getattr(arguments, option) < bound:
            parser.error(f"--{option} must be at least {bound}, is {getattr(arguments, option)}")
    if not arguments.print and arguments.scenes is None:
        parser.error("give SCENES")
    if arguments.list and arguments.what != "doubtful":
        parser.error("--list goes with doubtful")
    try:
        if arguments.print:
            rows = json.loads(arguments.json.read_text())["answers"]
        else:
            check_writable(arguments.json)
            rows = measure(arguments)
        if arguments.list:
            write_list(rows)
            rows = [it for it in rows if it["processor_s"] > EXPENSIVE_S]
    except (OSError, ValueError) as error:
        parser.error(str(error))
    print("\n".join(table(arguments.what, rows)))


def measure(arguments: argparse.Namespace) -> Sequence[Row]:
    """Asks what the arguments say."""
    scenes = Scenes(arguments.scenes)
    asked_of: dict[str, Callable[[Scenes], Iterable[Asked]]] = {
        "other-place": partial(other_places, references=arguments.references),
        "doubtful": candidates if arguments.list else doubtful,
        "turned": turned_photographs,
        "held": held_photographs,
    }
    asked = list(asked_of[arguments.what](scenes))
    # Whole photographs: one that is asked turned, is asked at every angle.
    each = {"turned": len(ANGLES_DEG), "held": len(ORIENTATIONS)}.get(arguments.what, 1)
    asked = [it for i, it in enumerate(asked) if i // each % arguments.every == 0]
    return ask(answers(asked, arguments.store), arguments.json, len(asked))


def ask(answered: Iterable[Row], file: Path, count: int) -> Sequence[Row]:
    """Collects the rows; the file is written after each, since a run takes minutes."""
    begin_s, rows = time.perf_counter(), list[Row]()
    for row in answered:
        rows.append(row)
        line = f"{len(rows)}/{count} {row['name']}: {row['outcome']}, {row['processor_s']:.1f} s"
        print(line, file=sys.stderr, flush=True)
        write_json(file, {"answers": rows})
    write_json(file, {"answers": rows})
    print(f"{time.perf_counter() - begin_s:.0f} s", file=sys.stderr)
    return rows


def table(what: str, rows: Sequence[Row]) -> list[str]:
    """The table of a file of answers."""
    if what == "turned":
        return by_turn(rows, "angle_deg")
    if what == "held":
        return by_turn(rows, "orientation")
    if what == "doubtful":
        return by("references", lambda row: row["references_stored"], rows)
    return by("asked", lambda row: "in other places", rows)


if __name__ == "__main__":
    main()
