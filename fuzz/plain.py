"""Mutations of bytes without atheris, which is not available everywhere."""

from collections.abc import Sequence
from random import Random

from .target import MutateBytes, Target

_MOST_AT_ONCE = 16


def mutator(random: Random, words: Sequence[bytes] = ()) -> MutateBytes:
    """A mutator that changes, inserts, removes or repeats some bytes."""

    def mutate(data: bytes) -> bytes:
        position = random.randrange(len(data) + 1)
        length = random.randrange(1, _MOST_AT_ONCE)
        kind = random.randrange(6)
        if kind == 0:
            return data[:position] + random.randbytes(length) + data[position + length :]
        if kind == 1:
            return data[:position] + random.randbytes(length) + data[position:]
        if kind == 2:
            return data[:position] + data[position + length :]
        if kind == 3:
            return data[:position] + data[position : position + length] * 2 + data[position + length :]
        if kind == 4 and words:
            return data[:position] + random.choice(words) + data[position:]
        changed = bytearray(data)
        if position < len(data):
            changed[position] ^= 1 << random.randrange(8)
        return bytes(changed)

    return mutate


def inputs(target: Target, count: int, seed: int) -> list[bytes]:
    """The target's seeds, and mutations of them one after the other."""
    random = Random(seed)
    mutate_bytes = mutator(random, target.words)
    made = list(target.seeds())
    seeds = len(made)
    for _ in range(count):
        # Mostly of what is right, now and then of what is broken already.
        origin = made[random.randrange(seeds if random.random() < 0.8 else len(made))]
        made.append(target.mutate(origin, random, mutate_bytes)[: target.max_bytes])
    return made
