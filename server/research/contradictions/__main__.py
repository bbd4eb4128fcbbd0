"""Asks the cases, or compares two files of answers; see the package."""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from mapless_tools.output_files import check_writable, write_json
from research.places import Scenes

from .asking import Row, ask_all
from .cases import KINDS, Case, cases_of
from .comparing import report, table


def main() -> None:
    """Asks, or prints the comparison; a folder or file that is wrong ends the program with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m research.contradictions", description=__doc__)
    parser.add_argument("scenes", type=Path, nargs="?", help="folder of the scenes' folders")
    parser.add_argument("--json", type=Path, help="file for the answers")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), help="kinds of cases; default: all")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th case of each kind; default: all")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"), help="two files of answers")
    arguments = parser.parse_args()
    try:
        if arguments.compare:
            before, after = (json.loads(it.read_text())["answers"] for it in arguments.compare)
            print("\n".join(report(before, after)))
            return
        if arguments.scenes is None or arguments.json is None:
            parser.error("give SCENES and --json, or --compare")
        if arguments.every < 1:
            parser.error(f"--every must be at least 1, is {arguments.every}")
        check_writable(arguments.json)
        cases = cases_of(Scenes(arguments.scenes), arguments.only, arguments.every)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    ask(cases, arguments.json)


def ask(cases: Sequence[Case], file: Path) -> None:
    """Asks the cases and prints the outcomes; the file is written after each, since a run takes minutes."""
    begin_s = time.perf_counter()
    answers: list[Row] = []
    for row in ask_all(cases):
        answers.append(row)
        print(
            f"{len(answers)}/{len(cases)} {row['kind']}: {row['name']}: {row['outcome']}", file=sys.stderr, flush=True
        )
        write_json(file, {"answers": answers})
    print("\n".join([*table(answers), "", f"{time.perf_counter() - begin_s:.0f} s"]))


if __name__ == "__main__":
    main()
