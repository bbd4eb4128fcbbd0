"""How far keypoints must be from the ignored pixels of a mask: `mapless_server.method.features.masks.MARGIN_PX`.

Every photograph of the demo's room, of half its size, carries the same opaque overlay, a badge or a bonnet, and a mask
of exactly its pixels. For each margin: the matches that photographs of other places (random shapes, with the overlay)
have with the reference that they match most; how many of them are localized, which is wrong, and how many of the room's
own, with the medians of their errors and features.

    PYTHONPATH=client:server python -m research.mask_margin

Features are SIFT's, or those of a network: --features aliked --weights FILE. Four minutes with SIFT.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features import masks
from mapless_server.method.features.extractors import FeatureExtractor, make_extractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.judge.answer import Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.pipeline import Pipeline
from mapless_tools.dataset import Frame
from mapless_tools.demo.photographs import ROOM
from mapless_tools.ingest.formats.cameras import read_folder

Image = NDArray[np.uint8]
Overlay = tuple[Image, NDArray[np.bool_]]
"""Pixels, and which of them it covers."""

MARGINS_PX = (0.0, 2.0, 4.0, 8.0)
OTHER_PLACES = 8
REFERENCES = 8


def shapes(width_px: int, height_px: int, seed: int, count: int, largest_px: int) -> Image:
    """An image of random discs and rectangles."""
    random = np.random.default_rng(seed)
    image = np.full((height_px, width_px, 3), random.integers(60, 200), np.uint8)
    for _ in range(count):
        x, y = int(random.integers(0, width_px)), int(random.integers(0, height_px))
        size, colour = int(random.integers(3, largest_px)), random.integers(0, 256, 3).tolist()
        if random.random() < 0.5:
            cv2.circle(image, (x, y), size, colour, -1, cv2.LINE_AA)
        else:
            cv2.rectangle(image, (x, y), (x + size, y + size), colour, -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.uint8)


def overlays(camera: Camera) -> dict[str, Overlay]:
    """A badge of 22x16 % in a corner, and a bonnet below an ellipse."""
    width, height = camera.width_px, camera.height_px
    badge, bonnet = np.zeros((height, width), np.uint8), np.zeros((height, width), np.uint8)
    badge[20 : 20 + int(0.16 * height), 20 : 20 + int(0.22 * width)] = 1
    cv2.ellipse(bonnet, (width // 2, height), (int(0.55 * width), int(0.3 * height)), 0, 0, 360, 1, -1)
    return {
        "badge": (shapes(width, height, 1, 6000, 12), badge > 0),
        "bonnet": (shapes(width, height, 2, 1200, 40), bonnet > 0),
    }


def with_overlay(image: Image, overlay: Overlay) -> Image:
    """The image with the overlay's pixels in it, as JPEG would have them: compressed together."""
    pixels, covered = overlay
    composed = np.where(covered[..., None], pixels, image)
    _, encoded = cv2.imencode(".jpg", composed[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
    return decode_image(encoded.tobytes(), ImageLimits())


def half_of(camera: Camera) -> Camera:
    """The camera of an image of half the size."""
    return camera.resized(camera.width_px // 2, camera.height_px // 2)


def measure(extractor: FeatureExtractor, frames: Sequence[Frame], overlay: Overlay, margin_px: float | None) -> str:
    """A row of the table; no margin: without masks."""
    masks.MARGIN_PX = 0.0 if margin_px is None else margin_px
    ignored = None if margin_px is None else overlay[1]
    camera = half_of(frames[0].camera)
    size = camera.width_px, camera.height_px

    def view_of(image: Image) -> PosedView:
        half = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        view = extractor.extract(with_overlay(half, overlay), camera, ignored)
        return PosedView("", "", view, frames[0].world_from_camera)

    views = [view_of(decode_image(it.image_path.read_bytes(), ImageLimits())) for it in frames]
    posed = [
        replace(view, key=frame.name, name=frame.name, world_from_camera=frame.world_from_camera)
        for view, frame in zip(views, frames, strict=True)
    ]
    queries, references = posed[1::3], [it for i, it in enumerate(posed) if i % 3 != 1]
    others = [view_of(shapes(2 * size[0], 2 * size[1], 100 + i, 900, 60)) for i in range(OTHER_PLACES)]
    pipeline = Pipeline(matcher=Matcher())

    def counts_of(query: PosedView) -> list[int]:
        return [len(it) for it in pipeline.matcher.match_quickly(query.view, references)]

    def answer(query: PosedView) -> Localization | None:
        best = [references[i] for i in np.argsort(counts_of(query), kind="stable")[::-1][:REFERENCES]]
        outcome = localize(query.view, best, pipeline, LocalizeOptions()).outcome
        return outcome if isinstance(outcome, Localization) else None

    most = np.median([max(counts_of(it)) for it in others])
    wrong = sum(answer(it) is not None for it in others)
    found = [(it, answer(it)) for it in queries]
    errors_cm = [
        100 * float(np.linalg.norm(answered.world_from_camera.translation - query.world_from_camera.translation))
        for query, answered in found
        if answered is not None
    ]
    features = np.median([len(it.view.features) for it in posed])
    name = "no mask" if margin_px is None else f"{margin_px:g} px"
    error = f"{np.median(errors_cm):.2f}" if errors_cm else "-"
    counts = f"{most:.0f} | {wrong} of {len(others)} | {len(errors_cm)} of {len(queries)}"
    return f"| {name} | {counts} | {error} | {features:.0f} |"


def main() -> None:
    """Prints a table for each overlay."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--features", default="sift")
    parser.add_argument("--weights", type=Path)
    arguments = parser.parse_args()
    extractor = make_extractor(arguments.features, arguments.weights)
    frames = read_folder(ROOM).frames
    for name, overlay in overlays(half_of(frames[0].camera)).items():
        print(f"{name}, {arguments.features}\n")
        print(
            "| margin | matches of other places | localized | own | error, cm | features |\n|---|---|---|---|---|---|"
        )
        for margin_px in (None, *MARGINS_PX):
            print(measure(extractor, frames, overlay, margin_px), flush=True)
        print()


if __name__ == "__main__":
    main()
