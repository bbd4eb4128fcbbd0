"""Overlays that are fixed to the camera: photographs of other places with the same one, and of the place itself."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.coarse.make import make_reconstructor
from mapless_server.method.features.extractors import FeatureExtractor, SiftExtractor, SiftOptions, make_extractor
from mapless_server.method.features.matching import mutual_matches
from mapless_server.method.features.views import Features, Matches, PosedView, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.localize import localize
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.make import make_matcher
from mapless_server.method.pairs.stationary import StationaryOptions, displacements_px, fixed_in, share_of_parts
from mapless_server.method.pipeline import Pipeline
from mapless_tools.dataset import Dataset
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.evaluate.plan import evenly_spread
from mapless_tools.evaluate.references import choose_references
from mapless_tools.ingest.formats.cameras import read_folder
from research.places import DRIVE, KITCHEN, RIGHT_M

from .overlays import OVERLAYS, Image, Mask, Overlay, black, nothing
from .page import Measurement, Row, least

ROOM = Path(__file__).parents[2] / "mapless_tools" / "demo" / "room"
REFERENCES = 10
"""References of a query."""
QUERIES = 6
"""Photographs of other places for each scene, overlay and features: 216 in all."""
RIGHT_QUERIES = 4
"""Photographs of the place itself for each of them: 144 in all."""
UNCHECKED = 2
"""How many of those of other places are asked with nothing ignored too."""
MAX_KEYPOINTS = 1024
"""Half of what a server takes, so that all is measured in minutes."""
OFF = StationaryOptions(support=1_000_000, unmoved_px=0.0)


@dataclass(frozen=True)
class Posed:
    """A photograph in the size that is measured, with its camera and pose."""

    name: str
    image: Image
    camera: Camera
    world_from_camera: RigidTransform


@dataclass(frozen=True)
class Scene:
    """A place that is asked: its references, photographs of it, and photographs of other places in its size."""

    name: str
    references: Sequence[Posed]
    queries: Sequence[Posed]
    others: Sequence[Image]


@dataclass(frozen=True)
class Drawn:
    """A scene whose photographs carry an overlay, with their features; and with the same pixels black and masked."""

    references: Sequence[PosedView]
    others: Sequence[View]
    queries: Sequence[PosedView]
    black_references: Sequence[PosedView]
    black_queries: Sequence[PosedView]


def scenes_in(folder: Path, count: int = QUERIES) -> list[Scene]:
    """The drive, the kitchen and the demo's room, each with photographs of other places."""
    room, kitchen, drive = (read_folder(it) for it in (ROOM, folder / KITCHEN, folder / DRIVE))
    elsewhere = [read_folder(folder / name) for name in ("tum-fr3-office", "meeting-room", "fountain-P11")]
    every = evenly_spread(list(range(len(kitchen.frames))), 14)
    between = [i for i in range(1, len(kitchen.frames) - 1) if i not in every]
    numbers = list(range(len(drive.frames)))
    return [
        _scene("drive", drive, 0.8, (numbers[::2], numbers[1:-1:2]), [drive, elsewhere[2]], count),
        _scene("kitchen", kitchen, 0.8, (every, between), [*elsewhere, room], count),
        scene_of_room([*elsewhere, kitchen], count),
    ]


def scene_of_room(places: Sequence[Dataset] = (), count: int = 0) -> Scene:
    """The demo's room, with so many photographs of other places."""
    room = read_folder(ROOM)
    chosen = [[i for i, it in enumerate(room.frames) if kind in it.name] for kind in ("reference", "query")]
    return _scene("room", room, 0.5, (chosen[0], chosen[1]), places, count)


def _scene(
    name: str,
    dataset: Dataset,
    scale: float,
    chosen: tuple[Sequence[int], Sequence[int]],
    places: Sequence[Dataset],
    count: int,
) -> Scene:
    references, queries = (
        [_posed(dataset, i, scale) for i in indices]
        for indices in (chosen[0], evenly_spread(list(chosen[1]), RIGHT_QUERIES))
    )
    camera = references[0].camera
    return Scene(name, references, queries, [_other(places, dataset, camera, i) for i in range(count)])


def _posed(dataset: Dataset, index: int, scale: float) -> Posed:
    frame = dataset.frames[index]
    camera = frame.camera.resized(round(scale * frame.camera.width_px), round(scale * frame.camera.height_px))
    image = cv2.resize(_read(dataset, index), (camera.width_px, camera.height_px), interpolation=cv2.INTER_AREA)
    return Posed(f"{frame.name}-{index}", np.asarray(image, np.uint8), camera, frame.world_from_camera)


def _other(places: Sequence[Dataset], scene: Dataset, camera: Camera, number: int) -> Image:
    """A photograph of another place, cut to the size of a camera; mirrored if it is of the same one."""
    place = places[number % len(places)]
    image = _read(place, number * 7919 % len(place.frames))
    if place is scene:
        image = np.ascontiguousarray(image[:, ::-1])
    scale = max(camera.width_px / image.shape[1], camera.height_px / image.shape[0]) + 1e-3
    image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return np.ascontiguousarray(image[-camera.height_px :, : camera.width_px])


def _read(dataset: Dataset, index: int) -> Image:
    return decode_image(dataset.frames[index].image_path.read_bytes(), ImageLimits())


def draw(scene: Scene, overlay: Overlay, extractor: FeatureExtractor) -> Drawn:
    """Draws an overlay on all photographs of a scene and of other places, and finds their features."""
    camera, dark = scene.references[0].camera, black(overlay)
    return Drawn(
        [_view(it, overlay, i, extractor, False) for i, it in enumerate(scene.references)],
        [with_overlay(it, camera, overlay, 500 + 31 * i, extractor, False) for i, it in enumerate(scene.others)],
        [_view(it, overlay, 300 + 7 * i, extractor, False) for i, it in enumerate(scene.queries)],
        [_view(it, dark, i, extractor, True) for i, it in enumerate(scene.references)],
        [_view(it, dark, 300 + 7 * i, extractor, True) for i, it in enumerate(scene.queries)],
    )


def _view(posed: Posed, overlay: Overlay, number: int, extractor: FeatureExtractor, masked: bool) -> PosedView:
    view = with_overlay(posed.image, posed.camera, overlay, number, extractor, masked)
    return PosedView(f"{posed.name}-{masked}", posed.name, view, posed.world_from_camera)


def with_overlay(
    image: Image, camera: Camera, overlay: Overlay, number: int, extractor: FeatureExtractor, masked: bool
) -> View:
    """The view of a photograph with an overlay; without the keypoints on it if `masked`."""
    drawn, mask = overlay(image, number)
    view = extractor.extract(encoded(drawn), camera)
    if not masked:
        return view
    kept, features = ~on_mask(view, mask), view.features
    return replace(
        view, features=Features(features.keypoints[kept], features.descriptors[kept], features.sizes_px[kept])
    )


def encoded(image: Image) -> Image:
    """The image as JPEG has it."""
    jpeg = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    decoded = cv2.imdecode(jpeg, cv2.IMREAD_COLOR_RGB)
    assert decoded is not None
    return np.asarray(decoded, np.uint8)


def on_mask(view: View, mask: Mask) -> NDArray[np.bool_]:
    """Returns whether each keypoint (N,) lies on a covered pixel or within 1 % of the width of one."""
    camera, (h, w) = view.camera, mask.shape
    side = 2 * round(0.01 * w) + 1
    wide = cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    at = np.clip((view.features.keypoints + 0.5) * (w / camera.width_px, h / camera.height_px), 0, (w - 1, h - 1))
    column, row = at.astype(int).T
    return np.asarray(wide[row, column] > 0)


def pipeline_of(features: str, options: StationaryOptions) -> Pipeline:
    """A pipeline with nothing cached."""
    pipeline = Pipeline(make_reconstructor("geometric", Path()), make_matcher(features, 1))
    pipeline.matcher.pairs.stationary = options
    return pipeline


def accepted(views: Sequence[View], references: Sequence[PosedView], pipeline: Pipeline) -> list[bool]:
    """Returns whether each photograph is localized."""
    return [localized(view, references, pipeline) is not None for view in views]


def right(queries: Sequence[PosedView], references: Sequence[PosedView], pipeline: Pipeline) -> list[bool]:
    """Returns whether each photograph of the place is localized rightly."""
    return [_is_right(it, references, pipeline) for it in queries]


def _is_right(query: PosedView, references: Sequence[PosedView], pipeline: Pipeline) -> bool:
    pose = localized(query.view, references, pipeline)
    return pose is not None and pose_error(query.world_from_camera, pose)[0] < RIGHT_M


def localized(query: View, references: Sequence[PosedView], pipeline: Pipeline) -> RigidTransform | None:
    """The pose of a photograph from the references that it matches most; None if it is rejected."""
    chosen = choose_references(query, references, REFERENCES, ratio=pipeline.matcher.options.query_ratio)
    outcome = localize(query, [references[i] for i in chosen], pipeline, LocalizeOptions()).outcome
    return outcome.world_from_camera if isinstance(outcome, Localization) else None


Window = tuple[Sequence[PosedView], dict[tuple[int, int], Matches]]
"""References, and the matches of their pairs by descriptors alone."""


def windows(references: Sequence[PosedView], ratio: float = 0.9) -> list[Window]:
    """Sets of ten references that follow one another, each half of the next one."""
    found: list[Window] = []
    for begin in range(0, max(1, len(references) - REFERENCES + 1), REFERENCES // 2):
        some = references[begin : begin + REFERENCES]
        pairs = combinations(range(len(some)), 2)
        matches = {(i, j): mutual_matches(some[i].view.features, some[j].view.features, ratio, True) for i, j in pairs}
        found.append((some, matches))
    return found


def ignored_share(sets: Sequence[Window], options: StationaryOptions) -> float:
    """Share of all keypoints of sets of references that are ignored."""
    ignored = count = 0
    for references, matches in sets:
        fixed = fixed_in(references, matches, options)
        ignored += sum(int(fixed.of(it.view).sum()) for it in references)
        count += sum(len(it.view.features) for it in references)
    return ignored / max(count, 1)


def clean(folder: Path, name: str, extractor: FeatureExtractor) -> list[PosedView]:
    """At most 30 photographs of a scene, as they are."""
    dataset = read_folder(folder / name)
    found = []
    for i in evenly_spread(list(range(len(dataset.frames))), min(30, len(dataset.frames))):
        frame = dataset.frames[i]
        view = extractor.extract(_read(dataset, i), frame.camera)
        found.append(PosedView(f"{name}-{i}", frame.name, view, frame.world_from_camera))
    return found


_ALTERNATIVES: dict[str, Sequence[Any]] = {
    "contradicted_px": (1.0, 2.0, 3.0, 4.0, 6.0, 8.0),
    "support": (1, 2, 3, 5, 10),
}


def _extractors() -> dict[str, FeatureExtractor]:
    """The features that are measured, by their names: without the weights of EdgePoint2, SIFT alone."""
    found: dict[str, FeatureExtractor] = {"sift": SiftExtractor(SiftOptions(max_keypoints=MAX_KEYPOINTS))}
    weights = Path(os.environ.get("MAPLESS_WEIGHTS_DIR", "")) / "edgepoint2-l64.safetensors"
    if weights.is_file():
        from mapless_server.method.features.extractors.edgepoint2 import EdgePoint2Extractor
        from mapless_server.method.features.extractors.options import LearnedOptions

        options = LearnedOptions(max_keypoints=MAX_KEYPOINTS, min_score=0.0067)
        found["edgepoint2-l64"] = EdgePoint2Extractor("l64", weights, options=options)
    return found


def _overlays(folder: Path) -> Iterator[Row]:
    extractors = _extractors()
    for scene in scenes_in(folder):
        for features, extractor in extractors.items():
            found = [compared(draw(scene, it, extractor), features) for it in OVERLAYS.values()]
            sums = {title: [flag for it in found for flag in it[title]] for title in found[0]}
            yield {
                "features": features,
                "scene": scene.name,
                **{title: f"{sum(some)} of {len(some)}" for title, some in sums.items()},
            }


def compared(drawn: Drawn, features: str) -> dict[str, list[bool]]:
    """One scene with one overlay: for each photograph whether it holds, by the titles of the page's columns."""
    checked = pipeline_of(features, StationaryOptions())
    return {
        "other places localized": accepted(drawn.others, drawn.references, checked),
        "the same, nothing ignored": accepted(drawn.others[:UNCHECKED], drawn.references, pipeline_of(features, OFF)),
        "right": right(drawn.queries, drawn.references, checked),
        "right, black and masked": right(
            drawn.black_queries, drawn.black_references, pipeline_of(features, StationaryOptions())
        ),
    }


def _unmoved(folder: Path) -> Iterator[Row]:
    extractor, drive = SiftExtractor(SiftOptions(max_keypoints=MAX_KEYPOINTS)), scenes_in(folder)[0]
    drawn = [draw(drive, OVERLAYS[name], extractor) for name in ("display", "watermark")]
    for value in (0.0, 1.0, 4.0, 8.0):  # strokes of half-transparent letters are found to three pixels
        wrong: list[bool] = []
        rightly: list[bool] = []
        for it in drawn:
            # A pipeline of its own: references have the same keys with each overlay.
            checked = pipeline_of("sift", replace(StationaryOptions(), unmoved_px=value))
            wrong += accepted(it.others, it.references, checked)
            rightly += right(it.queries, it.references, checked)
        yield {
            "unmoved_px": value,
            "other places localized": f"{sum(wrong)} of {len(wrong)}",
            "right": f"{sum(rightly)} of {len(rightly)}",
        }


def _same_view(folder: Path) -> Iterator[Row]:
    extractor, options = SiftExtractor(SiftOptions(max_keypoints=MAX_KEYPOINTS)), StationaryOptions()

    def share(first: View, second: View) -> float:
        matches = mutual_matches(first.features, second.features, 0.9, True)
        unmoved = matches[displacements_px(first, second, matches) <= options.unmoved_px]
        return share_of_parts(first, second, unmoved, options.parts)

    def seen(image: Image, overlay: Overlay, number: int) -> View:
        return with_overlay(image, camera, overlay, number, extractor, False)

    same: list[float] = []
    other: list[float] = []
    for scene in scenes_in(folder, 3):
        camera = scene.references[0].camera
        for it in scene.references[::4]:
            view = seen(it.image, nothing, 0)
            same += [share(view, seen(worse(it.image, *how), nothing, 0)) for how in WORSE]
        for overlay in OVERLAYS.values():
            first = seen(scene.references[0].image, overlay, 0)
            other += [share(first, seen(it, overlay, 500)) for it in scene.others]
    for value in (0.2, 0.3, 0.4, 0.5, 0.6):
        yield {
            "same_view_share": value,
            "the same view, recognized": f"{sum(it > value for it in same)} of {len(same)}",
            "another place with the same overlay, taken for it": f"{sum(it > value for it in other)} of {len(other)}",
        }


WORSE = ((1.3, 4.0, 0.5), (2.0, 8.0, 0.5), (0.6, 6.0, 1.0))
"""Exponents of brightness, noise and blur of photographs from the same place."""


def worse(image: Image, exponent: float, noise: float, blur_px: float) -> Image:
    """The photograph in another light, blurred, with noise."""
    lit = cv2.GaussianBlur(255 * (image / 255.0) ** exponent, (0, 0), blur_px)
    darker: Image = np.clip(lit + np.random.default_rng(0).normal(0, noise, lit.shape), 0, 255).astype(np.uint8)
    return darker


def _alternatives(field: str, folder: Path) -> Iterator[Row]:
    sets = windows(clean(folder, DRIVE, make_extractor("sift")))
    for value in _ALTERNATIVES[field]:
        options = replace(StationaryOptions(), **{field: value})
        yield {field: value, "ignored, %": f"{100 * ignored_share(sets, options):.2f}"}


MEASUREMENTS = {
    "stationary-overlays": Measurement(_overlays),
    "stationary-contradicted-px": Measurement(partial(_alternatives, "contradicted_px")),
    "stationary-support": Measurement(partial(_alternatives, "support")),
    "stationary-unmoved-px": Measurement(_unmoved, least("other places localized")),
    "stationary-same-view-share": Measurement(_same_view, least("another place with the same overlay, taken for it")),
}
