"""The bounds of adoption: photographs of real scenes, true ones and forged ones, localized with SIFT in this process.

A forged photograph has its right half moved by a share of its width, as if half of what it shows stood elsewhere.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from mapless.geometry import RigidTransform, rotation_angle_deg
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.scenes.adoption.policy import AdoptionOptions
from mapless_server.serve.adoption.evidence import rivals_of
from mapless_tools.evaluate.plan import evenly_spread
from mapless_tools.ingest.formats.cameras import read_folder
from research.described import Pair, answered, read_place, right_pairs
from research.places import FOUNTAIN, KITCHEN, LOCKERS, MEETING

from .page import Measurement, Row

SCENES = (KITCHEN, MEETING, LOCKERS, FOUNTAIN, "studio-flat")
"""Places by which none of the bounds was chosen."""
REFERENCES, QUERIES, CHOSEN = 30, 10, 10
MOVED = (0.0, 0.015, 0.06)
"""By how much the right half is moved, shares of the width; not at all in true photographs."""
BOUNDS = ((15, 2, 8), (30, 1, 8), (30, 2, 4), (30, 2, 8), (30, 2, 20), (30, 3, 8), (60, 2, 8), (120, 2, 8))
"""Least matches, least references, and least matches of each of these."""
IN_USE = AdoptionOptions()


@dataclass(frozen=True)
class Found:
    """An accepted answer.

    Attributes:
        moved: by how much half of the photograph is moved, share of its width.
        is_right: whether the pose is near enough to the true one.
        is_within: whether its error is within its 95 % radius.
        inlier_counts: matches of each reference that agree with it.
        rivals: matches that agree on another pose.
        compared: angle, degrees, and distance, share of that to what is shown, of each reference, and the share of the
            matches with it.
    """

    moved: float
    is_right: bool
    is_within: bool
    inlier_count: int
    inlier_counts: tuple[int, ...]
    rivals: int
    compared: tuple[tuple[float, float, float], ...]


def _forged(folder: Path, index: int, pair: Pair, moved: float) -> Pair:
    """The pair with its query forged."""
    frame = read_folder(folder).frames[index]
    image = decode_image(frame.image_path.read_bytes(), ImageLimits()).copy()
    width = image.shape[1]
    image[:, width // 2 :] = np.roll(image, round(moved * width), axis=1)[:, width // 2 :]
    return replace(pair, query=make_extractor("sift").extract(image, frame.camera), title=f"{pair.title}:{moved}")


@cache
def _found(scenes: Path) -> tuple[Found, ...]:
    """Accepted answers to the photographs of all scenes."""
    return tuple(it for name in SCENES for it in _found_in(scenes / name))


def asked_in(folder: Path, queries: int) -> list[tuple[int, Pair]]:
    """Photographs of a place, so many, with the references that are chosen for them; and their frames' indices."""
    count = len(read_folder(folder).frames)
    indices = evenly_spread(range(count), min(count, REFERENCES + QUERIES))
    place = read_place(folder, indices)
    references = min(REFERENCES, 3 * len(indices) // 4)
    asked = list(right_pairs(place, references, [CHOSEN]))
    index_of = {id(view): i for i, view in place.views.items()}
    chosen = [asked[i] for i in evenly_spread(range(len(asked)), min(queries, len(asked)))]
    return [(index_of[id(it.query)], it) for it in chosen]


def _found_in(folder: Path) -> Iterator[Found]:
    asked = asked_in(folder, QUERIES)
    pairs = [it if not moved else _forged(folder, i, it, moved) for i, it in asked for moved in MOVED]
    for i, measured in enumerate(answered(pairs)):
        answer, true = measured.answer, measured.pair.true_pose
        if isinstance(answer.outcome, Localization) and measured.off is not None and true is not None:
            yield _of(answer, measured.pair, measured.right, measured.off[0], true, MOVED[i % len(MOVED)])


def _of(answer: Answer, pair: Pair, is_right: bool, off_m: float, true: RigidTransform, moved: float) -> Found:
    support = answer.support
    assert isinstance(support, PosedSupport)
    assert isinstance(answer.outcome, Localization)
    assert answer.outcome.covariance is not None
    deviations = np.sqrt(np.linalg.eigvalsh(answer.outcome.covariance[:3, :3]))
    total = max(answer.outcome.inlier_count, 1)
    compared = []
    for it, inliers in zip(pair.references, answer.reference_inlier_counts, strict=True):
        pose = it.world_from_camera
        apart = float(np.linalg.norm(pose.translation - true.translation)) / support.distance_m()
        angle = rotation_angle_deg(pose.rotation.T @ true.rotation)
        compared.append((angle, apart, inliers / total))
    is_within = off_m <= 2.8 * float(deviations.max())
    counts = tuple(answer.reference_inlier_counts)
    return Found(moved, is_right, is_within, total, counts, rivals_of(support), tuple(compared))


def _share(of: Iterable[bool]) -> str:
    values = list(of)
    return f"{sum(values)} of {len(values)}"


def _match_rows(scenes: Path) -> Iterator[Row]:
    true = [it for it in _found(scenes) if not it.moved]
    for matches, vouchers, each in BOUNDS:
        bounds = matches, vouchers, each
        kept = [
            it for it in true if it.inlier_count >= matches and sum(k >= each for k in it.inlier_counts) >= vouchers
        ]
        name = f"{matches}; {vouchers} with {each}"
        is_used = bounds == (IN_USE.min_matches, IN_USE.min_vouchers, IN_USE.voucher_matches)
        yield {
            "least matches; references with as many": f"**{name}**" if is_used else name,
            "true photographs that may vouch": f"{len(kept)} of {len(true)}",
            "of them wrong": sum(not it.is_right for it in kept),
            "within the 95 % radius": _share(it.is_within for it in kept),
        }


def _rival_rows(scenes: Path) -> Iterator[Row]:
    found = [it for it in _found(scenes) if it.inlier_count >= IN_USE.min_matches]
    for bound in (10, 15, 20, 30, 50, 100):
        refused = {moved: _share(it.rivals >= bound for it in found if it.moved == moved) for moved in MOVED}
        yield {
            "rival matches": f"**{bound}**" if bound == IN_USE.min_rivals else bound,
            "true photographs refused": refused[0.0],
            **{f"moved by {100 * it:g} % refused": refused[it] for it in MOVED if it},
        }


def _contradiction_rows(scenes: Path) -> Iterator[Row]:
    compared = np.array([it for found in _found(scenes) if not found.moved for it in found.compared]).reshape(-1, 3)
    for degrees, apart in ((5.0, 0.05), (15.0, 0.15), (15.0, 0.3), (30.0, 0.15), (30.0, 0.3)):
        near = compared[(compared[:, 0] <= degrees) & (compared[:, 1] <= apart)]
        name = f"{degrees:g} deg, {100 * apart:g} %"
        is_used = (degrees, apart) == (IN_USE.same_viewpoint_deg, IN_USE.same_viewpoint_share)
        yield {
            "viewpoint within": f"**{name}**" if is_used else name,
            "pairs": len(near),
            **{f"share below {100 * bound:g} %": int((near[:, 2] < bound).sum()) for bound in (0.02, 0.05, 0.1, 0.2)},
        }


MEASUREMENTS = {
    "adoption-matches": Measurement(_match_rows),
    "adoption-rivals": Measurement(_rival_rows),
    "adoption-contradictions": Measurement(_contradiction_rows),
}
"""From the same answers."""
