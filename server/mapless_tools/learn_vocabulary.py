"""How the shipped vocabularies were made: `python -m mapless_tools.learn_vocabulary`, ten minutes on a CPU core.

Rooms are furnished, textured and lit from random numbers, and photographed from anywhere in them with a camera that
errs in exposure and colour, blurs and has noise. From the features of these photographs the vocabularies are learned.
Nothing else goes in. Run again it gives the same file up to the last digits of a float16, in which libraries of linear
algebra may differ; descriptors are named after the very numbers, so another file means that stored ones are made anew.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mapless_server.method.features import FeatureExtractor, make_extractor
from mapless_server.networks.weights import find_weights
from mapless_server.scenes.retrieval.vocabulary import FILE, LEARNED, Floats, Vocabulary, learned
from mapless_tools.demo.room import Photo, render_room

ROOMS = range(100, 110)
PHOTOGRAPHS = 14
"""Of each room."""

EVERY = {"sift": 1, "aliked": 3, "xfeat": 1}
"""Of the photographs, the first of so many is looked at: ALIKED takes two seconds each on a CPU."""

DESCRIPTORS = 60_000
"""That are learned from, drawn from all; twice as many change no figure."""


def main() -> None:
    """Learns and writes the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--weights-dir", type=Path, required=True, help="where the features' weights are")
    parser.add_argument("--output", type=Path, default=Path(__file__).with_name(FILE))
    arguments = parser.parse_args()
    photographs = list(rendered())
    vocabularies = {kind: of_kind(kind, photographs, arguments.weights_dir) for kind in LEARNED}
    write(arguments.output, vocabularies)
    for kind, vocabulary in vocabularies.items():
        print(f"{kind}: {vocabulary.digest()}")


def rendered() -> Iterator[Photo]:
    """Photographs of the rooms."""
    for seed in ROOMS:
        yield from render_room(seed, 0, PHOTOGRAPHS)[1]
        print(f"room {seed}: {PHOTOGRAPHS} photographs", flush=True)


def of_kind(kind: str, photographs: list[Photo], weights_dir: Path) -> Vocabulary:
    """The vocabulary of a kind of features."""
    extractor = make_extractor(kind, None if kind == "sift" else find_weights(kind, weights_dir))
    descriptors = np.concatenate([_descriptors(extractor, photo) for photo in photographs[:: EVERY[kind]]])
    print(f"{kind}: {len(descriptors)} features", flush=True)
    drawn = np.random.default_rng(0).choice(len(descriptors), min(DESCRIPTORS, len(descriptors)), replace=False)
    return learned(descriptors[np.sort(drawn)])


def write(path: Path, vocabularies: dict[str, Vocabulary]) -> None:
    """The file, float16."""
    parts = {
        f"{kind}_{part}": getattr(vocabulary, part).astype(np.float16)
        for kind, vocabulary in vocabularies.items()
        for part in ("mean", "projection", "words")
    }
    np.savez_compressed(path, allow_pickle=False, **parts)


def _descriptors(extractor: FeatureExtractor, photo: Photo) -> Floats:
    return extractor.extract(photo.image, photo.camera).features.descriptors


if __name__ == "__main__":
    main()
