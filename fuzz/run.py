"""Fuzzes one target with atheris: `python -m fuzz.run NAME --output FOLDER --runs N --seed S`; or tries one input.

Fuzzing does not return, so each target has a process of its own. Beyond what a target itself finds wrong, an input is a
finding that makes the process larger or takes longer than any input may.
"""

import argparse
import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from random import Random

import atheris

from .target import TARGETS, load

MAX_GROWTH_BYTES = 200 * 2**20
"""Largest growth of the process by one input: more than the largest image takes that a target accepts, by far."""
MAX_CPU_S = 3.0
"""Largest processor time of one input of some kilobytes; not wall time, since machines are shared."""
_HANG_S = 60
_TOLD_EVERY = 1000
_ANEW_SHARE = 0.4
"""Share of inputs that are made of what is right; libFuzzer's corpus mostly is refused in yet another way."""


class Watched:
    """A target's check, watched and counted."""

    def __init__(self, check: Callable[[bytes], bool], counts: Path) -> None:
        self._check = check
        self._counts = counts
        self._inputs = self._accepted = 0

    def __call__(self, data: bytes) -> None:
        """Called by libFuzzer."""
        before_s, before_bytes = time.process_time(), _peak_bytes()
        accepted = self._check(data)
        spent_s, grown_bytes = time.process_time() - before_s, _peak_bytes() - before_bytes
        assert grown_bytes <= MAX_GROWTH_BYTES, f"{len(data)} bytes of input took {grown_bytes / 2**20:.0f} MiB"
        assert spent_s <= MAX_CPU_S, f"{len(data)} bytes of input took {spent_s:.1f} s"
        self._inputs += 1
        self._accepted += accepted
        if self._inputs % _TOLD_EVERY == 0:
            self._counts.write_text(json.dumps({"inputs": self._inputs, "accepted": self._accepted}))


def _peak_bytes() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    """Fuzzing does not return."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.run", description=__doc__)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--output", type=Path, default=Path(), help="Folder of the corpus, and of findings.")
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--input", type=Path, help="A finding, to be tried alone.")
    arguments = parser.parse_args()
    if arguments.input is not None:
        print("accepted" if load(arguments.target).check(arguments.input.read_bytes()) else "refused")
        return
    with atheris.instrument_imports(include=["mapless", "mapless_server", "mapless_tools"]):
        target = load(arguments.target)

    seeds = target.seeds()
    corpus: Path = arguments.output / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for i, seed in enumerate(seeds):
        (corpus / f"seed-{i:02d}").write_bytes(seed)
    dictionary = arguments.output / "words"
    dictionary.write_text("".join('"' + "".join(f"\\x{byte:02x}" for byte in word) + '"\n' for word in target.words))

    def mutate(data: bytes, max_bytes: int, seed: int) -> bytes:
        random = Random(seed)
        if random.random() < _ANEW_SHARE:
            data = random.choice(seeds)
        return target.mutate(data, random, lambda part: atheris.Mutate(part, max_bytes))[:max_bytes]

    flags = {
        "runs": arguments.runs,
        "seed": arguments.seed,
        "max_len": target.max_bytes,
        "timeout": _HANG_S,
        # The peak of the program that started this one, such as a worker of the tests, counts as its own.
        "rss_limit_mb": 2048 + _peak_bytes() // 2**20,
        **({"dict": dictionary} if target.words else {}),
        "artifact_prefix": f"{arguments.output}/",
        "close_fd_mask": 2,  # what native decoders say of broken files would fill the disk
        "print_final_stats": 1,
    }
    command = [sys.argv[0], *(f"-{name}={value}" for name, value in flags.items()), str(corpus)]
    atheris.Setup(command, Watched(target.check, arguments.output / "counts.json"), custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
