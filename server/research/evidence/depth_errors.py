"""Errors of measured depths, by what many photographs triangulate: those that a photograph shares, and neighbours.

EdgePoint2, every second photograph of a folder, 18 at most; points that are known to a hundredth of their distance.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_server.method.features.views import PosedView
from mapless_server.method.structure.structure import StructureOptions, observe, triangulated_structure
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_tools.ingest.formats.cameras import read_folder

from ..depth_places import CACHE, SENSORS, known, posed, with_cache
from .page import Measurement, Row

FRAMES, LEAST = 18, 40
LARGEST_SIGMA = 0.01
DISTANCES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Between keypoints, shares of the width."""
ITERATIONS = 20


def rows(scenes: Path) -> Iterator[Row]:
    """A row for each place."""
    (tier, *_) = make_tiers(load_settings({"features": "edgepoint2-l64"}).settings)
    cached = with_cache(tier, CACHE)
    for place in SENSORS:
        frames = [known(it, place) for it in read_folder(scenes / "depth" / place).frames]
        references = posed(place, frames[::2][:FRAMES], cached)
        pairs = tier.pipeline.matcher.correspond(references[0].view, references)
        structure = triangulated_structure(references, pairs, StructureOptions())
        observations = observe(structure.tracks, references, structure.noise)
        covariances = observations.point_covariances(structure.x_in_world)
        photos = []
        for i, reference in enumerate(references):
            seen = np.flatnonzero(structure.tracks.view == i)
            point, keypoint = structure.tracks.point[seen], structure.tracks.keypoint[seen]
            photos.append(_excess(reference, structure.x_in_world[point], covariances[point], keypoint))
        yield _row(place, [it for it in photos if len(it[0]) >= LEAST])


def _excess(
    reference: PosedView, points: Array, covariances: Array, keypoint: NDArray[np.intp]
) -> tuple[Array, Array, Array]:
    """By which shares depths are too long, (n,), the inverse depths, and pixels by the width (n, 2)."""
    assert reference.depths is not None
    axis, view = reference.world_from_camera.rotation[:, 2], reference.view
    depth = (points - reference.world_from_camera.translation) @ axis
    sigma = np.sqrt(np.einsum("i,oij,j->o", axis, covariances, axis)) / depth
    excess = reference.depths.depth[keypoint] / depth - 1
    usable = np.isfinite(excess) & (sigma < LARGEST_SIGMA)
    pixels = view.features.pixels(keypoint) / view.camera.width_px
    return excess[usable], 1 / depth[usable], pixels[usable]


def _row(place: str, photos: list[tuple[Array, Array, Array]]) -> Row:
    factors, offsets, before, after = [], [], list[Array](), list[Array]()
    for excess, inverse, _ in photos:
        factor = _fitted(excess, np.ones((len(excess), 1)))
        both = _fitted(excess, np.stack([np.ones(len(excess)), inverse], axis=1))
        factors.append(factor[0])
        offsets.append(both[1])
        before.append(excess - factor[0])
        after.append(excess - both[0] - both[1] * inverse)
    correlations, regions = _correlations(after, [it[2] for it in photos])
    scatter = _spread(np.concatenate(before)), _spread(np.concatenate(after))
    return {
        "place": place,
        "depths": sum(len(it) for it in after),
        "factor - 1, median and spread": f"{100 * np.median(factors):.1f} %, {100 * _spread(np.array(factors)):.1f} %",
        "offset, quartiles": " to ".join(f"{1000 * it:.0f}" for it in np.quantile(offsets, [0.25, 0.75])) + " mm",
        "scatter without offset, with": f"{100 * scatter[0]:.2f} %, {100 * scatter[1]:.2f} %",
        "correlation within 2, 5, 10, 20, 30 % of the width": ", ".join(f"{it:.2f}" for it in correlations),
        "regions": f"{regions:.0f}",
    }


def _fitted(excess: Array, slopes: Array) -> Array:
    """Robust least squares."""
    weight = np.ones(len(excess))
    found: Array = np.zeros(slopes.shape[1])
    sigma = _spread(excess)
    for _ in range(ITERATIONS):
        root = np.sqrt(weight)
        found = np.asarray(np.linalg.lstsq(slopes * root[:, None], excess * root, rcond=None)[0])
        weight = 1 / (1 + ((excess - slopes @ found) / (2 * sigma)) ** 2)
    return found


def _correlations(residuals: list[Array], pixels: list[Array]) -> tuple[Array, float]:
    """Correlation of residuals of a photograph by their distance, and the number of regions that average out alike."""
    bins = len(DISTANCES) - 1
    sums, counts, total = np.zeros(bins), np.zeros(bins), 0
    sigma = _spread(np.concatenate(residuals))
    clipped = [np.clip(it, -3 * sigma, 3 * sigma) for it in residuals]
    for residual, at in zip(clipped, pixels, strict=True):
        first, second = np.triu_indices(len(residual), 1)
        which = np.digitize(np.linalg.norm(at[first] - at[second], axis=1), DISTANCES) - 1
        total += len(first)
        inside = which < bins
        product = (residual[first] * residual[second])[inside]
        sums += np.bincount(which[inside], product, minlength=bins)
        counts += np.bincount(which[inside], minlength=bins)
    variance = np.mean(np.concatenate(clipped) ** 2)
    shared = float(np.maximum(sums, 0).sum() / total / variance)
    return sums / counts / variance, 1 / shared


def _spread(values: Array) -> float:
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def fewest(found: Sequence[Row]) -> int:
    """The fewest regions of a place."""
    return min(int(str(it["regions"])) for it in found)


MEASUREMENTS = {"depth-errors": Measurement(rows, decide=fewest)}
