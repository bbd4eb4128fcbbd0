"""Photographs that show something new: real places, with parts of photographs exchanged for another place.

The photograph's right part is that of a photograph of the next place; it is localized with SIFT in this process.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.judge.answer import Localization
from mapless_server.scenes.adoption.policy import AdoptionOptions, explained, novelty
from mapless_server.serve.adoption.evidence import inliers_of
from mapless_server.services.messages.debug import sent_pixels
from mapless_tools.ingest.formats.cameras import read_folder
from research.described import Pair, answered

from .adopting import IN_USE, SCENES, asked_in
from .page import Measurement, Row

QUERIES = 6
EXCHANGED = (0.0, 0.2, 0.4)
"""Shares of the width that show another place."""
NEAR_SHARES, LEAST = (0.02, 0.04, 0.08), (0.1, 0.2, 0.3)


@dataclass(frozen=True)
class Answered:
    """A localized photograph of which this share was exchanged: its novelty, for each of `NEAR_SHARES`."""

    exchanged: float
    novelties: tuple[float, ...]


def _exchanged(folder: Path, other: Path, index: int, pair: Pair, share: float) -> Pair:
    """The pair with the right part of its query exchanged for that of a photograph of another place."""
    frame, frames = read_folder(folder).frames[index], read_folder(other).frames
    image, shown = (
        decode_image(it.image_path.read_bytes(), ImageLimits()) for it in (frame, frames[index % len(frames)])
    )
    image, width = image.copy(), image.shape[1]
    begin = width - round(share * width)
    image[:, begin:] = cv2.resize(shown, (width, image.shape[0]))[:, begin:]
    return replace(pair, query=make_extractor("sift").extract(image, frame.camera), title=f"{pair.title}:{share}")


def _answered(scenes: Path) -> Iterator[Answered]:
    for number, name in enumerate(SCENES):
        folder, other = scenes / name, scenes / SCENES[(number + 1) % len(SCENES)]
        pairs = [
            _exchanged(folder, other, i, it, share) if share else it
            for i, it in asked_in(folder, QUERIES)
            for share in EXCHANGED
        ]
        for i, measured in enumerate(answered(pairs)):
            support = measured.answer.support
            if isinstance(measured.answer.outcome, Localization) and isinstance(support, PosedSupport):
                yield Answered(EXCHANGED[i % len(EXCHANGED)], tuple(_novelty(support, it) for it in NEAR_SHARES))


def _novelty(support: PosedSupport, near_share: float) -> float:
    camera = support.query.photograph.camera if support.query.photograph else support.query.camera
    options = replace(IN_USE, explained_share=near_share)
    near = explained((camera.width_px, camera.height_px), inliers_of(support), options)
    return novelty(sent_pixels(support.query, support.query.features.keypoints), near)


def _rows(scenes: Path) -> Iterator[Row]:
    found = list(_answered(scenes))
    for i, near_share in enumerate(NEAR_SHARES):
        for least in LEAST:
            name = f"{100 * near_share:g} %; {100 * least:g} %"
            of = {share: [it.novelties[i] for it in found if it.exchanged == share] for share in EXCHANGED}
            yield {
                "explained within; least share": f"**{name}**" if _is_used(near_share, least) else name,
                **{_title(share): f"{sum(it >= least for it in its)} of {len(its)}" for share, its in of.items()},
                "median share, as it is": f"{100 * float(np.median(of[0.0])):.0f} %",
            }


def _title(share: float) -> str:
    return f"{100 * share:g} % exchanged: new" if share else "as it is: new"


def _is_used(near_share: float, least: float) -> bool:
    return (near_share, least) == (AdoptionOptions.explained_share, AdoptionOptions.min_novelty)


MEASUREMENTS = {"adoption-novelty": Measurement(_rows)}
