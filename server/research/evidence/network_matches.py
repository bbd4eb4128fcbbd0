"""Matches of LightGlue: how many keypoints it needs, and how many matches the two best references show by chance."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapless_server.engine.query import Tier
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.matching import OPTIONS
from mapless_server.method.features.views import PosedView
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pairs.epipolar import sampson_px
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_tools.dataset import Frame
from research.places import Scenes, own_and_other

from .page import Measurement, Row

KEYPOINTS = (256, 512, 1024)
THRESHOLDS = (10, 15, 20, 30, 40)
QUERIES, BEST = 2, 2
RIGHT_PX, ENOUGH_RIGHT = 4.0, 15


@dataclass(frozen=True)
class Found:
    """The matches of a photograph with the better of two references: their number, right ones, and the time of a pair.

    `is_own` says whether it shows the place.
    """

    is_own: bool
    keypoints: int
    most: int
    most_right: int
    seconds: float


def by_keypoints(found: Sequence[Found]) -> Iterator[Row]:
    """For each number of keypoints, the photographs of the place with enough right matches, and the time."""
    for keypoints in KEYPOINTS:
        own = [it for it in found if it.keypoints == keypoints and it.is_own]
        rights = [it.most_right for it in own]
        yield {
            "keypoints": keypoints,
            f"with {ENOUGH_RIGHT} right matches": f"{sum(it >= ENOUGH_RIGHT for it in rights)} of {len(own)}",
            "right matches, median": f"{np.median(rights):.0f}",
            "s of a pair, median": f"{np.median([it.seconds for it in own]):.2f}",
        }


def by_threshold(found: Sequence[Found]) -> Iterator[Row]:
    """For each threshold, the photographs that have so many matches, with the keypoints that the code has."""
    used = [it for it in found if it.keypoints == OPTIONS["aliked"].rematched_keypoints]
    others = [it.most for it in used if not it.is_own]
    right = [it.most for it in used if it.is_own and it.most_right >= ENOUGH_RIGHT]
    for threshold in THRESHOLDS:
        yield {
            "matches at least": threshold,
            "of other places": f"{sum(it >= threshold for it in others)} of {len(others)}",
            f"of the place, {ENOUGH_RIGHT} right": f"{sum(it >= threshold for it in right)} of {len(right)}",
        }


def _all_found(scenes: Path) -> Iterator[Found]:
    tier = make_tiers(load_settings({}).settings)[-1]
    matcher = tier.pipeline.matcher
    for _, place, own, others in own_and_other(Scenes(scenes), QUERIES):
        references = [_posed(it, tier) for it in place.reference_frames]
        for frame, is_own in [*((it, True) for it in own), *((it, False) for it in others)]:
            yield from _found(_posed(frame, tier), references, matcher, is_own)


def _posed(frame: Frame, tier: Tier) -> PosedView:
    image = decode_image(frame.image_path.read_bytes(), ImageLimits())
    view = tier.extractor.extract(image, frame.camera)
    return PosedView(frame.name, frame.name, view, frame.world_from_camera)


def _found(query: PosedView, references: Sequence[PosedView], matcher: Matcher, is_own: bool) -> Iterator[Found]:
    counts = [len(it) for it in matcher.match_quickly(query.view, references)]
    best = [references[i] for i in np.argsort(counts)[::-1][:BEST]]
    for keypoints in KEYPOINTS:
        options = replace(matcher.options, rematched_keypoints=keypoints)
        rematching = Matcher(options, pair_matching=matcher.pair_matching)
        begin_s = time.process_time()
        matches = [rematching.rematch(query.view, it) for it in best]
        seconds = (time.process_time() - begin_s) / len(best)
        rematching.close()
        rights = [
            int((sampson_px(query, it, found) <= RIGHT_PX).sum()) if is_own and len(found) else 0
            for it, found in zip(best, matches, strict=True)
        ]
        yield Found(is_own, keypoints, max(map(len, matches)), max(rights), seconds)


MEASUREMENTS = {
    "rematched-keypoints": Measurement(lambda scenes: by_keypoints(list(_all_found(scenes)))),
    "promising-matches": Measurement(lambda scenes: by_threshold(list(_all_found(scenes)))),
}
