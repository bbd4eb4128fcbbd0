"""What depth kept with the references gives to few of them: `python -m research.kept_depth ../shared/data`.

No network runs: the depths at the references' keypoints in the kitchen of 7-Scenes are triangulated from all its
frames but the queries, and get an error of 2 %: one of each keypoint, or half of it common to all of a reference. A
tenth is wrong in a third variant. Prints the number of queries localized and the median errors with 10, 5, 3 and 2
references, with and without depths.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from mapless.geometry import Array
from mapless_server.method.answer import Localization
from mapless_server.method.correspond import Matcher, make_matcher
from mapless_server.method.uncertainty.radii import accuracy_from_covariance
from mapless_server.method.views import KeypointDepths

from .one_reference import triangulated_depth
from .places import KITCHEN, QUERIES, Pair, Place, answered, read_place, right_pairs, spread

COUNTS = (10, 5, 3, 2)
SIGMA = 0.02
AROUND, STEP, LEAST_COSINE = 180, 6, 0.7
"""A reference's depths are triangulated from every sixth of the nearest 180 frames that look in about its direction."""
FLAT, NEAR_PX = 0.03, 40.0
"""Keypoints between three of these that differ by less, as a share of the depth, and are nearer, get theirs."""


@dataclass(frozen=True)
class Noise:
    """Errors of planted depths.

    `each` and `common` are relative standard deviations, of each depth and of all of a reference; `wrong` is the share
    of the depths that are off by a factor of up to 2.
    """

    each: float = SIGMA
    common: float = 0.0
    wrong: float = 0.0

    def planted(self, depth: Array, random: np.random.Generator) -> KeypointDepths:
        """The depths with these errors."""
        log_error = self.each * random.normal(size=len(depth)) + self.common * random.normal()
        wrong = random.random(len(depth)) < self.wrong
        log_error[wrong] += random.uniform(-np.log(2), np.log(2), wrong.sum())
        return KeypointDepths((depth * np.exp(log_error)).astype(np.float32), float(np.hypot(self.each, self.common)))


NOISES = {
    "2 % each": Noise(),
    "1.4 % each and 1.4 % common": Noise(SIGMA / 2**0.5, SIGMA / 2**0.5),
    "2 % each, 10 % of them wrong": Noise(wrong=0.1),
}


def true_depths(place: Place, references: Sequence[int], without: set[int], matcher: Matcher) -> dict[int, Array]:
    """Depth (N,) at the keypoints of some frames, triangulated from frames around them, and in between."""
    found = {}
    for index in references:
        pose, others = place.poses[index], [i for i in place.views if i != index and i not in without]
        others.sort(key=lambda i: float(np.linalg.norm(place.poses[i].translation - pose.translation)))
        alike = [i for i in others if place.poses[i].rotation[:, 2] @ pose.rotation[:, 2] > LEAST_COSINE]
        depth = triangulated_depth(place.posed([index, *alike[:AROUND:STEP]]), matcher)
        assert depth is not None
        found[index] = filled(depth, place.views[index].features.keypoints.astype(float))
    return found


def filled(depth: Array, keypoints: Array) -> Array:
    """With those of keypoints in the triangles of known neighbours that are near and at about one depth."""
    known = np.isfinite(depth)
    mesh, logarithm = Delaunay(keypoints[known], qhull_options="QJ"), np.log(depth[known])
    corners = mesh.simplices
    sides_px = np.linalg.norm(keypoints[known][corners] - keypoints[known][np.roll(corners, 1, axis=1)], axis=2)
    flat = (np.ptp(logarithm[corners], axis=1) < FLAT) & (sides_px.max(axis=1) < NEAR_PX)
    between = LinearNDInterpolator(mesh, logarithm)(keypoints)
    inside = mesh.find_simplex(keypoints)
    return np.asarray(np.where(known, depth, np.where((inside >= 0) & flat[inside], np.exp(between), np.nan)))


def with_depths(pair: Pair, depths: dict[int, Array], noise: Noise, random: np.random.Generator) -> Pair:
    """The pair whose references have depths."""
    planted = tuple(
        replace(it, depths=noise.planted(depths[int(it.key.rsplit("-", 1)[1])], random)) for it in pair.references
    )
    return replace(pair, references=planted)


def report(title: str, pairs: Sequence[Pair], features: str) -> None:
    """Prints a line."""
    begin_s, offs, holds, wrong = time.process_time(), [], [], 0
    for it in answered(pairs, features=features):
        outcome = it.answer.outcome
        if not isinstance(outcome, Localization) or outcome.covariance is None or it.off is None:
            continue
        wrong += not it.right
        offs.append(it.off)
        holds.append(it.off[0] <= accuracy_from_covariance(outcome.covariance).position_68_m)
    errors = np.array(offs)
    spent_ms = 1000 * (time.process_time() - begin_s) / len(pairs)
    (median_m, median_deg), far_m = np.median(errors, axis=0), np.quantile(errors[:, 0], 0.9)
    print(f"{title}: {len(errors)} of {len(pairs)} localized, {wrong} wrong, median {100 * median_m:.2f} cm "
          f"{median_deg:.3f} deg, 90 % {100 * far_m:.2f} cm, {100 * np.mean(holds):.0f} % within 68 % radii, "
          f"{spent_ms:.0f} ms", flush=True)  # fmt: skip


def main() -> None:
    """Prints everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    measure(read_place(parser.parse_args().data / KITCHEN, wanted=range(600)), "sift")


def measure(place: Place, features: str) -> None:
    """Prints a line for each number of references and kind of noise."""
    matcher = make_matcher(features, 1)
    for count in COUNTS:
        indices = sorted(place.views)
        references = spread(indices, count)
        queries = spread([i for i in indices[1:-1] if i not in references], QUERIES)
        pairs = list(right_pairs(place, count, (count,), features=features))
        report(f"{count} references", pairs, features)
        if count == COUNTS[0]:
            continue
        depths = true_depths(place, references, set(queries), matcher)
        share = np.mean([np.isfinite(it).mean() for it in depths.values()])
        for title, noise in NOISES.items():
            random = np.random.default_rng(1)
            given = [with_depths(it, depths, noise, random) for it in pairs]
            report(f"{count} references, depths of {100 * share:.0f} % of the keypoints, {title}", given, features)


if __name__ == "__main__":
    main()
