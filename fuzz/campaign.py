"""Fuzzes all targets, each in a process of its own, and reports the results: `python -m fuzz.campaign`, `make fuzz`.

Written to the output folder: a table for people and one for programs, and for each target its log, its corpus, which
the next campaign begins with, and what broke a law: `python -m fuzz.run TARGET --input FILE` tries one again.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from . import folders
from .target import TARGETS

ROOT = Path(__file__).parents[1]
_SUPPORT = ROOT / "tests"
"""Where the package `support` is, which targets use."""
_FINDINGS = ("crash-*", "timeout-*", "oom-*", "leak-*")
_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENCV_LOG_LEVEL": "SILENT",
    "PYTHONWARNINGS": "ignore",  # of overflow, which inputs provoke
}


@dataclass(frozen=True)
class Outcome:
    """The result of one target.

    Attributes:
        target, area: which.
        inputs: that were tried, mutations of the corpus.
        accepted: of them, those that the code under test took for right.
        edges, features: coverage of our Python code as libFuzzer counts it.
        seconds: by the wall clock.
        findings: files of inputs that broke a law.
        exit_code: of the process; 0 if it came to its end.
    """

    target: str
    area: str
    inputs: int
    accepted: int
    edges: int
    features: int
    seconds: float
    findings: tuple[str, ...]
    exit_code: int

    @property
    def per_second(self) -> float:
        """Inputs a second."""
        return self.inputs / self.seconds if self.seconds else 0.0


def fuzz(target: str, output: Path, runs: int, seed: int, limit_s: float | None = None) -> Outcome:
    """Fuzzes one target until it has had so many inputs, or until one breaks a law.

    Raises:
        subprocess.TimeoutExpired: it took longer than the limit, and was ended.
    """
    folder = output / target
    folder.mkdir(parents=True, exist_ok=True)
    for old in (file for pattern in _FINDINGS for file in folder.glob(pattern)):
        old.unlink()
    (folder / "counts.json").unlink(missing_ok=True)
    arguments = [target, "--output", str(folder.resolve()), "--runs", str(runs), "--seed", str(seed)]
    path = os.pathsep.join(filter(None, (str(_SUPPORT), os.environ.get("PYTHONPATH"))))
    begin_s = time.monotonic()
    with (folder / "log").open("wb") as log, tempfile.TemporaryDirectory(prefix="fuzz-", dir=folders.memory()) as place:
        ended = subprocess.run(
            [sys.executable, "-m", "fuzz.run", *arguments],
            cwd=ROOT,
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": path, folders.MEMORY_VARIABLE: place},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            timeout=limit_s,
            check=False,
        )
    return _outcome(target, folder, time.monotonic() - begin_s, ended.returncode)


def _outcome(target: str, folder: Path, seconds: float, exit_code: int) -> Outcome:
    log = (folder / "log").read_text(errors="replace")
    counts: Mapping[str, int] = {}
    if (folder / "counts.json").is_file():
        counts = json.loads((folder / "counts.json").read_text())
    findings = tuple(sorted(str(file) for pattern in _FINDINGS for file in folder.glob(pattern)))
    return Outcome(
        target,
        TARGETS[target],
        _last(r"number_of_executed_units: (\d+)", log),
        counts.get("accepted", 0),
        _last(r" cov: (\d+) ft:", log),
        _last(r" ft: (\d+) ", log),
        seconds,
        findings,
        exit_code,
    )


def _last(pattern: str, log: str) -> int:
    found = re.findall(pattern, log)
    return int(found[-1]) if found else 0


def table(outcomes: Sequence[Outcome]) -> str:
    """For people, as Markdown."""
    lines = [
        "| area | target | inputs | accepted | edges | features | seconds | inputs a second | findings |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for it in outcomes:
        share = f"{100 * it.accepted / it.inputs:.0f} %" if it.inputs else "-"
        lines.append(
            f"| {it.area} | {it.target} | {it.inputs:,} | {share} | {it.edges} | {it.features} | {it.seconds:.0f} | "
            f"{it.per_second:,.0f} | {len(it.findings)} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Exits with 1 if anything was found, or a target did not come to its end."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.campaign", description=__doc__)
    parser.add_argument("--targets", nargs="*", choices=[*TARGETS, []], default=[], help="All, if none is named.")
    parser.add_argument("--runs", type=int, default=1_000_000, help="Inputs for each target.")
    parser.add_argument("--seed", type=int, default=0, help="Of the mutations; 0: another one each time.")
    parser.add_argument("--parallel", type=int, default=1, help="Targets at a time.")
    parser.add_argument("--output", type=Path, default=Path("fuzz-output"))
    arguments = parser.parse_args()
    names = arguments.targets or [*TARGETS]
    arguments.output.mkdir(parents=True, exist_ok=True)
    outcomes: list[Outcome] = []

    def one(name: str) -> None:
        outcome = fuzz(name, arguments.output, arguments.runs, arguments.seed)
        outcomes.append(outcome)
        outcomes.sort(key=lambda it: names.index(it.target))
        print(table([outcome]).splitlines()[-1], flush=True)
        (arguments.output / "campaign.md").write_text(table(outcomes))
        (arguments.output / "campaign.json").write_text(json.dumps([asdict(it) for it in outcomes], indent=1))

    with ThreadPoolExecutor(arguments.parallel) as pool:
        list(pool.map(one, names))
    print(table(outcomes))
    for outcome in outcomes:
        for finding in outcome.findings:
            print(f"{outcome.target}: {finding}")
    sys.exit(any(it.findings or it.exit_code for it in outcomes))


if __name__ == "__main__":
    main()
