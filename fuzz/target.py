"""The interface of a fuzz target, and the list of targets."""

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random

MutateBytes = Callable[[bytes], bytes]
"""Changes bytes of which nothing is known: libFuzzer's own mutations, or `plain`'s."""

Mutator = Callable[[bytes, Random, MutateBytes], bytes]
"""Makes an input of another: knows the input's structure, and leaves parts without one to the second function."""

TARGETS = {
    "images": "image decoding",
    "exif": "image decoding",
    "depth": "image decoding",
    "localization": "request validation",
    "references": "request validation",
    "metadata": "request validation",
    "gateway": "request validation",
    "colmap": "importers",
    "captures": "importers",
    "benchmarks": "importers",
    "configuration": "text of operators",
}
"""The area of each target by its name, which is its module's too."""


@dataclass(frozen=True, eq=False)
class Target:
    """Code that reads untrusted input.

    Attributes:
        seeds: makes inputs that are right, or nearly so, and together show all that there is.
        check: whether an input was accepted; raises whatever the code under test must not raise, and AssertionError
            where what it made of the input breaks a law.
        mutate: see Mutator.
        max_bytes: of an input: enough for several of what can be repeated.
        words: of the format, which mutations insert.
    """

    seeds: Callable[[], Sequence[bytes]]
    check: Callable[[bytes], bool]
    mutate: Mutator
    max_bytes: int = 8192
    words: tuple[bytes, ...] = ()


def load(name: str) -> Target:
    """The target of a name."""
    target: Target = importlib.import_module(f"fuzz.{name}").TARGET
    return target
