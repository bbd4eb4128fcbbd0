"""Measures what wrong depth of references does, on folders with depth (`cameras.json`), through a server.

    python -m research.depth_mistakes ADDRESS FOLDER... [--pairs 12]

Two references that overlap, of which one has a wrong depth: whether the server warns of its depth, and of which of the
two. All references of a folder, with their own depth: how many warnings there are, and the factors of their depths. One
reference alone with a wrong depth: how many answers to photographs that show half of its points, how many of these are
more than 5 % of the median depth off, and how many outside their 95 % radius. Scenes that it makes are deleted.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless import Client, DepthImage, DepthNoise, LocalizationResult, NewReference
from mapless.geometry import Array
from mapless_server.images import ImageLimits, decode_depth
from mapless_server.method.structure.measured_depth import MeasuredDepth
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder

from .depth_places import MIN_VISIBLE, STEP
from .depth_tables import WRONG_SHARE

SHIFT_SHARE = 20 / 640
CAMERA_RATIO = 585 / 525
"""Focal lengths of a Kinect's depth and colour camera."""
STRUCTURED_LIGHT = DepthNoise(0.0012, 0.0, 0.0019, 0.02)


@dataclass(frozen=True)
class Mistake:
    """A name, and how a depth image becomes wrong, given another frame's."""

    name: str
    make: Callable[[DepthImage, DepthImage], DepthImage]


def _values(depth: DepthImage) -> NDArray[np.uint16]:
    return np.asarray(cv2.imdecode(np.frombuffer(depth.data, np.uint8), cv2.IMREAD_UNCHANGED), np.uint16)


def moved(change: Callable[[NDArray[np.uint16]], NDArray[np.uint16]]) -> Callable[[DepthImage, DepthImage], DepthImage]:
    """The mistake that changes the values of a PNG."""

    def make(depth: DepthImage, other: DepthImage) -> DepthImage:
        return replace(depth, data=cv2.imencode(".png", change(_values(depth)))[1].tobytes())

    return make


def shifted(values: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """To the right by `SHIFT_SHARE` of the width."""
    step = round(SHIFT_SHARE * values.shape[1])
    found = np.zeros_like(values)
    found[:, step:] = values[:, :-step]
    return found


def of_another_camera(depth: DepthImage, other: DepthImage) -> DepthImage:
    """Enlarged about its middle, as the depth of a Kinect's depth camera taken for the colour camera's is."""
    values = _values(depth)
    height, width = values.shape
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), 0, CAMERA_RATIO)
    enlarged = cv2.warpAffine(values, matrix, (width, height), flags=cv2.INTER_NEAREST)
    return replace(depth, data=cv2.imencode(".png", enlarged)[1].tobytes())


def scaled(factor: float) -> Callable[[DepthImage, DepthImage], DepthImage]:
    """The mistake of a wrong unit."""
    return lambda depth, other: replace(depth, unit_m=factor * depth.unit_m)


MISTAKES = (
    Mistake("none", scaled(1.0)),
    Mistake("1000 times too long", scaled(1000.0)),
    Mistake("1.1 times too long", scaled(1.1)),
    Mistake("1.1 times, structured_light", lambda a, b: replace(scaled(1.1)(a, b), noise=STRUCTURED_LIGHT)),
    Mistake("0.9 times as long", scaled(0.9)),
    Mistake("shifted by 20 px of 640", moved(shifted)),
    Mistake("mirrored", moved(lambda it: np.ascontiguousarray(it[:, ::-1]))),
    Mistake("turned by 180 degrees", moved(lambda it: np.ascontiguousarray(it[::-1, ::-1]))),
    Mistake("another camera's", of_another_camera),
    Mistake("another frame's", lambda depth, other: replace(depth, data=other.data)),
)


def main() -> None:
    """Prints the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address")
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--pairs", type=int, default=12)
    arguments = parser.parse_args()
    with Client(arguments.address) as client:
        print("| place | references with their own depth | warnings |\n|---|---|---|")
        for folder in arguments.folders:
            _all(client, folder.name, read_folder(folder).frames)
        print("\n| place | depth | pairs | warned, named first | warned of both | of the other alone |")
        print("|---|---|---|---|---|---|", flush=True)
        for folder in arguments.folders:
            _pairs(client, folder.name, read_folder(folder).frames, arguments.pairs)
        print("\n| place | depth, of one reference alone | localized | wrong | outside 95 % |\n|---|---|---|---|---|")
        for folder in arguments.folders:
            _alone(client, folder.name, read_folder(folder).frames, arguments.pairs)


def _all(client: Client, place: str, frames: Sequence[Frame]) -> None:
    with _scene(client, [_new(it, it.read_depth()) for it in frames]) as (scene, _):
        warnings = _warnings(client, scene, rounds=len(frames) // 4)
        print(f"| {place} | {len(frames)} | {'; '.join(warnings) or 'none'} |", flush=True)


def _pairs(client: Client, place: str, frames: Sequence[Frame], most: int) -> None:
    chosen = _overlapping(frames, most)
    for mistake in MISTAKES:
        counts = [0, 0, 0]
        for i, j in chosen:
            wrong = mistake.make(_depth(frames[i]), _depth(frames[(i + len(frames) // 2) % len(frames)]))
            new = [_new(frames[i], wrong, "wrong"), _new(frames[j], frames[j].read_depth(), "right")]
            with _scene(client, new) as (scene, at_once):
                text = " ".join([*at_once, *_warnings(client, scene)])
            named = [it in text for it in ("'wrong': it is", "'wrong': it does", "median depth of reference 'wrong'")]
            doubted = "either this depth is wrong" in text
            counts[0 if any(named) else 1 if doubted else 2] += bool(text)
        print(f"| {place} | {mistake.name} | {len(chosen)} | {' | '.join(map(str, counts))} |", flush=True)


def _alone(client: Client, place: str, frames: Sequence[Frame], most: int) -> None:
    chosen = _overlapping(frames, most)
    for mistake in MISTAKES:
        found: list[Outcome | None] = []
        for i, j in chosen:
            wrong = mistake.make(_depth(frames[i]), _depth(frames[(i + len(frames) // 2) % len(frames)]))
            with _scene(client, [_new(frames[i], wrong)]) as (scene, _):
                found.append(localized(client, scene, frames[j], points_of(frames[i])[1]))
        answers = [it for it in found if it is not None]
        off, outside = sum(it.share > WRONG_SHARE for it in answers), sum(it.of_95 > 1 for it in answers)
        print(f"| {place} | {mistake.name} | {len(answers)} of {len(found)} | {off} | {outside} |", flush=True)


def _overlapping(frames: Sequence[Frame], most: int) -> list[tuple[int, int]]:
    """Pairs whose second photograph shows half of the first one's points, in an order that is always the same.

    They are at least two frames apart.
    """
    pairs = [(i, j) for i in range(len(frames)) for j in range(len(frames)) if abs(i - j) > 1 and frames[i].depth]
    np.random.default_rng(0).shuffle(pairs)
    found: Iterator[tuple[int, int]] = (
        (i, j) for i, j in pairs if visible_share(points_of(frames[i])[0], frames[j]) >= MIN_VISIBLE
    )
    return [pair for pair, _ in zip(found, range(most), strict=False)]


@dataclass(frozen=True)
class Outcome:
    """An answer: its error by the median depth of the reference, and by its 95 % radius."""

    share: float
    of_95: float


def localized(client: Client, scene: str, frame: Frame, median_m: float) -> Outcome | None:
    """Localizes a frame's photograph in a scene whose depth has a median; None without a pose."""
    answer = client.localize(frame.image_path, frame.camera, scene, ignore_calibration=True)
    if not isinstance(answer, LocalizationResult) or answer.accuracy is None:
        return None
    error_m = float(np.linalg.norm(answer.world_from_camera.translation - frame.world_from_camera.translation))
    return Outcome(error_m / median_m, error_m / answer.accuracy.position_95_m)


def points_of(frame: Frame) -> tuple[Array, float]:
    """Points (P, 3) of a frame's depth in the world, and its median."""
    image, photo = _depth(frame), frame.camera
    depth = decode_depth(image, (photo.width_px, photo.height_px), ImageLimits())
    camera = image.camera or photo.resized(*depth.shape[::-1])
    points = MeasuredDepth(camera, depth, image.known_noise).points()[::STEP]
    if image.camera_from_depth_camera is not None:
        points = image.camera_from_depth_camera.apply(points)
    return frame.world_from_camera.apply(points), float(np.median(points[:, 2]))


def visible_share(points: Array, frame: Frame) -> float:
    """Share of points (P, 3) that a frame's photograph would show if nothing hid them."""
    x = frame.world_from_camera.inverse().apply(points)
    in_front = x[:, 2] > 0
    pixels = frame.camera.project(np.where(in_front[:, None], x, [0.0, 0.0, 1.0]))
    inside = ((pixels >= 0) & (pixels < (frame.camera.width_px, frame.camera.height_px))).all(axis=1)
    return float((in_front & inside).mean())


def _new(frame: Frame, depth: DepthImage | None, name: str = "") -> NewReference:
    return NewReference(name or frame.name, frame.image_path, frame.camera, frame.world_from_camera, depth=depth)


def _depth(frame: Frame) -> DepthImage:
    found = frame.read_depth()
    assert found is not None
    return found


def _warnings(client: Client, scene: str, rounds: int = 1) -> list[str]:
    """Sentences about depths; each look at a scene has the server compare some more."""
    for _ in range(rounds):
        client.get_scene(scene)
    return [it for it in client.get_scene(scene).warnings if "depth of reference" in it]


@contextmanager
def _scene(client: Client, new: Sequence[NewReference]) -> Iterator[tuple[str, set[str]]]:
    """A scene with these references, and the warnings that came with their answer."""
    scene = "depth-mistakes"
    client.create_scene(scene)
    try:
        stored = client.add_references(scene, new)
        yield scene, {warning for it in stored for warning in it.warnings}
    finally:
        client.delete_scene(scene)


if __name__ == "__main__":
    main()
