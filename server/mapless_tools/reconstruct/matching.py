"""The pairs of photographs that are compared, their matches, and the geometry of each pair, in pycolmap's database."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from mapless.geometry import Array
from mapless_server.bounds import check_bounds
from mapless_server.method.features.matching import mutual_matches_of_ratios
from mapless_server.method.features.views import Matches
from mapless_server.method.pairs.epipolar import fundamental_inliers
from mapless_server.scenes.retrieval.vlad import VladDescriptor
from mapless_tools.output_files import whole_file
from mapless_tools.progress import Progress, tracked

from .cameras import StartingCamera
from .features import FeatureFolder, in_colmap_pixels
from .native import interruptible

SEED = 0
_ITERATIONS = 100, 2000
"""Least and most, of the search for a fundamental matrix."""


@dataclass(frozen=True)
class PairOptions:
    """The choice of pairs of photographs to compare.

    Attributes:
        all_below: so many photographs and fewer are all compared with one another.
        steps: of more, each is compared with those so many places later in the order in which they were taken,
        similar: and with so many that are most similar to it, wherever they are in that order.
    """

    all_below: int = 60
    steps: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 16)
    similar: int = 20

    def __post_init__(self) -> None:
        check_bounds(self, "all_below similar", at_least=0)
        if not self.steps or min(self.steps) < 1:
            raise ValueError(f"steps must be at least 1, are {self.steps}")


ChoosePairs = Callable[[Sequence[str], FeatureFolder, VladDescriptor, PairOptions, Progress], list[tuple[str, str]]]
"""A function like `pairs_of`."""


def pairs_of(
    names: Sequence[str], features: FeatureFolder, descriptor: VladDescriptor, options: PairOptions, progress: Progress
) -> list[tuple[str, str]]:
    """The pairs of photographs to compare, in the order of the names, of which no two are equal."""
    if len(names) <= options.all_below:
        return list(combinations(names, 2))
    vectors = np.stack(
        [descriptor.describe(features.view(it)) for it in tracked("similarity", names, len(names), progress)]
    )
    count, chosen = len(names), set[tuple[int, int]]()
    for step in options.steps:
        chosen |= {(i, i + step) for i in range(count - step)}
    for i, row in enumerate(vectors @ vectors.T):
        others = [j for j in np.argsort(-row, kind="stable").tolist() if j != i]
        fresh = [j for j in others if (min(i, j), max(i, j)) not in chosen]
        chosen |= {(min(i, j), max(i, j)) for j in fresh[: options.similar]}
    return [(names[i], names[j]) for i, j in sorted(chosen)]


class MatchFolder:
    """Matches of pairs, in a file for each photograph of a folder; those that are there are not made again."""

    def __init__(self, folder: Path, features: FeatureFolder, ratio: float) -> None:
        self._folder = folder
        self._features = features
        self._ratio = ratio

    def match(self, pairs: Sequence[tuple[str, str]], progress: Progress) -> None:
        """Matches each photograph with those that it is paired with."""
        self._folder.mkdir(parents=True, exist_ok=True)
        seconds: dict[str, list[str]] = {}
        for first, second in pairs:
            seconds.setdefault(first, []).append(second)
        done = 0
        for first, others in seconds.items():
            progress("matches", done, len(pairs))
            file = self._folder / f"{first}.npz"
            if not file.is_file():
                found = [self._matches(first, second) for second in others]
                ends = np.cumsum([len(it) for it in found])
                with whole_file(file) as partial, partial.open("wb") as stream:
                    np.savez(stream, names=np.array(others), ends=ends, matches=np.concatenate(found))
            done += len(others)
        progress("matches", done, len(pairs))

    def of(self, first: str) -> dict[str, Matches]:
        """The matches of a photograph with those after it, by their names."""
        file = self._folder / f"{first}.npz"
        if not file.is_file():
            return {}
        with np.load(file) as arrays:
            found = np.split(arrays["matches"], arrays["ends"][:-1])
            return dict(zip(arrays["names"].tolist(), found, strict=True))

    def _matches(self, first: str, second: str) -> Matches:
        """Nearest descriptors that fit one fundamental matrix; pycolmap takes seconds to find that others do not."""
        views = self._features.view(first), self._features.view(second)
        found = mutual_matches_of_ratios(views[0].features, views[1].features, (self._ratio,))[0]
        return found[fundamental_inliers(*views, found, _ITERATIONS)]


@dataclass(frozen=True, eq=False)
class Evidence:
    """The features of photographs of one kind, their matches, and a key of what these depend on."""

    kind: str
    features: FeatureFolder
    matches: MatchFolder
    key: str


def write_database(
    file: Path, cameras: Sequence[StartingCamera], names: Sequence[str], evidence: Sequence[Evidence]
) -> None:
    """Writes cameras, keypoints and matches; images are numbered from 1 in the order of the names.

    An image has the keypoints of all kinds of features, those of the first before those of the next.
    """
    camera_of = {name: number for number, it in enumerate(cameras, 1) for name in it.names}
    image_of = {name: number for number, name in enumerate(names, 1)}
    with pycolmap.Database.open(file) as database, pycolmap.DatabaseTransaction(database):
        for number, camera in enumerate(cameras, 1):
            colmap_camera = camera.to_colmap(number)
            database.write_camera(colmap_camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(colmap_camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for name, number in image_of.items():
            image = pycolmap.Image(name=name, camera_id=camera_of[name], image_id=number)
            image.frame_id = number
            frame = pycolmap.Frame(frame_id=number, rig_id=camera_of[name])
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)
            database.write_image(image, use_image_id=True)
        before = dict.fromkeys(names, 0)
        keypoints: dict[str, list[Array]] = {name: [] for name in names}
        matches: dict[tuple[str, str], list[Matches]] = {}
        for it in evidence:
            for first in names:
                for second, found in it.matches.of(first).items():
                    matches.setdefault((first, second), []).append(found + (before[first], before[second]))
            for name in names:
                keypoints[name].append(in_colmap_pixels(it.features.view(name)))
                before[name] += len(keypoints[name][-1])
        for name, number in image_of.items():
            database.write_keypoints(number, np.concatenate(keypoints[name]).astype(np.float32))
        for (first, second), kinds in matches.items():
            database.write_matches(image_of[first], image_of[second], np.concatenate(kinds).astype(np.uint32))


def verify(file: Path, threads: int) -> None:
    """Finds the geometry of each pair of a database: essential matrix, homography or none."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    token = pycolmap.CancellationToken()
    interruptible(
        lambda: pycolmap.geometric_verification(
            file,
            pycolmap.GeometricVerifierOptions(num_threads=threads),
            two_view_geometry_options=options,
            cancellation_token=token,
        ),
        token.cancel,
    )
