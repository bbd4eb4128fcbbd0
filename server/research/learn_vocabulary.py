"""Vocabularies for retrieval, learned from rendered rooms in ten minutes on a CPU core.

    PYTHONPATH=client:server python -m research.learn_vocabulary --weights-dir FOLDER --output FILE

Rooms are furnished, textured and lit from random numbers, and photographed from anywhere in them with a camera that
errs in exposure and colour, blurs and has noise. From the features of these photographs the vocabularies are learned.
Nothing else goes in. The shipped ones were learned so from the rooms of an earlier renderer (`git show
04d45625:server/research/rendered_room`); those of the present one give others. Descriptors are named after the very
numbers, so another file means that stored ones are made anew.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from mapless.geometry import Camera
from mapless_server.method.features import make_extractor
from mapless_server.networks.weights import find_weights
from mapless_server.scenes.retrieval.vlad import LEARNED, REDUCED, SEED, WORDS, Floats, Vocabulary

from .rendered_room.furniture import lit_room
from .rendered_room.photographs import photograph, scatter

View = tuple[NDArray[np.uint8], Camera]

ROOMS = range(100, 110)
PHOTOGRAPHS = 14
"""Of each room."""
EVERY = {"sift": 1, "aliked": 3, "xfeat": 1, "edgepoint2-l64": 1}
"""Of the photographs, the first of so many is looked at: ALIKED takes two seconds each on a CPU."""
DESCRIPTORS = 60_000
"""That are learned from, drawn from all; twice as many change no figure."""


def main() -> None:
    """Learns and writes the file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--weights-dir", type=Path, required=True, help="where the features' weights are")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    photographs = list(rendered())
    vocabularies = {kind: of_kind(kind, photographs, arguments.weights_dir) for kind in LEARNED}
    write(arguments.output, vocabularies)
    for kind, vocabulary in vocabularies.items():
        print(f"{kind}: {vocabulary.digest()}")


def rendered() -> Iterator[View]:
    """Photographs of the rooms."""
    for seed in ROOMS:
        room = lit_room(seed)
        for station in scatter(seed, PHOTOGRAPHS, room):
            yield photograph(room, station, seed), station.camera
        print(f"room {seed}: {PHOTOGRAPHS} photographs", flush=True)


def of_kind(kind: str, photographs: Sequence[View], weights_dir: Path) -> Vocabulary:
    """The vocabulary of a kind of features."""
    extractor = make_extractor(kind, None if kind == "sift" else find_weights(kind, weights_dir))
    descriptors = np.concatenate(
        [extractor.extract(*it).features.unit_descriptors() for it in photographs[:: EVERY[kind]]]
    )
    print(f"{kind}: {len(descriptors)} features", flush=True)
    drawn = np.random.default_rng(0).choice(len(descriptors), min(DESCRIPTORS, len(descriptors)), replace=False)
    return learned(descriptors[np.sort(drawn)])


def learned(descriptors: Floats) -> Vocabulary:
    """A vocabulary from descriptors (N, d), N at least WORDS: principal directions, and k-means.

    Its numbers are rounded to float16, as the file keeps them.
    """
    random = np.random.default_rng(SEED)
    mean = descriptors.mean(axis=0)
    _, directions = np.linalg.eigh(np.cov(descriptors, rowvar=False))
    directions = directions[:, ::-1][:, :REDUCED]
    # Directions have no sign of their own: the largest number is positive, whatever the library that found them.
    directions = directions * np.sign(directions[np.abs(directions).argmax(axis=0), np.arange(directions.shape[1])])
    mean, projection = _rounded(mean), _rounded(directions)
    points: Floats = ((descriptors - mean) @ projection).astype(np.float32)
    words: Floats = points[random.choice(len(points), WORDS, replace=False)]
    words, _ = kmeans2(points, words, iter=25, minit="matrix")  # a word that is nearest to no point stays where it is
    return Vocabulary(mean, projection, _rounded(words))


def _rounded(array: NDArray[np.floating]) -> Floats:
    return array.astype(np.float16).astype(np.float32)


def write(path: Path, vocabularies: dict[str, Vocabulary]) -> None:
    """The file, float16."""
    parts = {
        f"{kind}_{part}": getattr(vocabulary, part).astype(np.float16)
        for kind, vocabulary in vocabularies.items()
        for part in ("mean", "projection", "words")
    }
    np.savez_compressed(path, allow_pickle=False, **parts)


if __name__ == "__main__":
    main()
