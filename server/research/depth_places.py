"""Measures what the depth of references is worth, on folders with depth (`cameras.json`), through a server.

    python -m research.depth_places ADDRESS FOLDER... [--pairs 40] [--queries 15]

One reference with depth: photographs in which half of its depth is visible are localized by it alone. Several: 3, 5
and 10 references, evenly spread, with their depth and without, and photographs between them. An answer is wrong if it
is off by more than 5 % of the median depth. Scenes that it makes are deleted.
"""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless import Client, LocalizationResult, NewReference
from mapless_server.images import ImageLimits, decode_depth
from mapless_server.method.structure.measured_depth import MeasuredDepth
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder

WRONG_SHARE = 0.05
MIN_VISIBLE = 0.5
COUNTS = (3, 5, 10)
STEP = 37
"""Every so many pixels of a depth are projected."""


@dataclass(frozen=True)
class Outcome:
    """An answer: its error by the median depth, by both radii; None without a pose."""

    share: float
    of_68: float
    of_95: float
    error_m: float


def main() -> None:
    """Prints both tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address")
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--queries", type=int, default=15)
    arguments = parser.parse_args()
    with Client(arguments.address) as client:
        print(
            "| place | one reference: localized | wrong | median error | in 68 % | in 95 % |\n|---|---|---|---|---|---|"
        )
        for folder in arguments.folders:
            _print(folder.name, _alone(client, read_folder(folder).frames, arguments.pairs))
        print("\n| place | references | depth | localized | wrong | median error |\n|---|---|---|---|---|---|")
        for folder in arguments.folders:
            _several(client, folder.name, read_folder(folder).frames, arguments.queries)


def _alone(client: Client, frames: Sequence[Frame], most: int) -> list[Outcome | None]:
    """Outcomes of pairs, in an order that is random and always the same."""
    pairs = [(i, j) for i in range(len(frames)) for j in range(len(frames)) if i != j and frames[i].depth]
    np.random.default_rng(0).shuffle(pairs)
    found: list[Outcome | None] = []
    for i, j in pairs:
        points, median_m = _points(frames[i])
        if _visible_share(points, frames[j]) < MIN_VISIBLE:
            continue
        with _scene(client, [frames[i]], has_depth=True) as scene:
            found.append(_localized(client, scene, frames[j], median_m))
        if len(found) == most:
            break
    return found


def _several(client: Client, place: str, frames: Sequence[Frame], most: int) -> None:
    for count in COUNTS:
        chosen = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int)).tolist()
        queries = [it for it in range(len(frames)) if it not in chosen]
        queries = [queries[i] for i in np.unique(np.linspace(0, len(queries) - 1, most).astype(int))]
        median_m = float(np.median([_points(frames[i])[1] for i in chosen]))
        for has_depth in (False, True):
            with _scene(client, [frames[i] for i in chosen], has_depth) as scene:
                found = [_localized(client, scene, frames[i], median_m) for i in queries]
            right = [it for it in found if it is not None]
            wrong = sum(it.share > WRONG_SHARE for it in right)
            error = f"{1000 * np.median([it.error_m for it in right]):.1f} mm" if right else ""
            depth = "with" if has_depth else "without"
            print(f"| {place} | {count} | {depth} | {len(right)} of {len(found)} | {wrong} | {error} |", flush=True)


def _print(place: str, found: Sequence[Outcome | None]) -> None:
    right = [it for it in found if it is not None]
    wrong = sum(it.share > WRONG_SHARE for it in right)
    median = 100 * np.median([it.share for it in right])
    in_68, in_95 = (100 * np.mean([getattr(it, name) <= 1 for it in right]) for name in ("of_68", "of_95"))
    count = f"{len(right)} of {len(found)}"
    print(f"| {place} | {count} | {wrong} | {median:.2f} % | {in_68:.0f} % | {in_95:.0f} % |", flush=True)


@contextmanager
def _scene(client: Client, frames: Sequence[Frame], has_depth: bool) -> Iterator[str]:
    scene = "depth-places"
    client.create_scene(scene)
    try:
        new = (
            NewReference(
                it.name, it.image_path, it.camera, it.world_from_camera, depth=it.read_depth() if has_depth else None
            )
            for it in frames
        )
        client.add_references(scene, new)
        yield scene
    finally:
        client.delete_scene(scene)


def _localized(client: Client, scene: str, frame: Frame, median_m: float) -> Outcome | None:
    answer = client.localize(frame.image_path, frame.camera, scene, ignore_calibration=True)
    if not isinstance(answer, LocalizationResult) or answer.accuracy is None:
        return None
    error_m = float(np.linalg.norm(answer.world_from_camera.translation - frame.world_from_camera.translation))
    return Outcome(
        error_m / median_m, error_m / answer.accuracy.position_68_m, error_m / answer.accuracy.position_95_m, error_m
    )


def _points(frame: Frame) -> tuple[np.ndarray, float]:
    """Points (P, 3) of a frame's depth in the world, and its median."""
    assert frame.depth is not None
    image, photo = frame.depth.read(), frame.camera
    depth = decode_depth(image, (photo.width_px, photo.height_px), ImageLimits())
    camera = image.camera or photo.resized(*depth.shape[::-1])
    points = MeasuredDepth(camera, depth, image.known_noise).points()[::STEP]
    if image.camera_from_depth_camera is not None:
        points = image.camera_from_depth_camera.apply(points)
    return frame.world_from_camera.apply(points), float(np.median(points[:, 2]))


def _visible_share(points: np.ndarray, frame: Frame) -> float:
    """Share of points (P, 3) that a frame's photograph would show if nothing hid them."""
    x = frame.world_from_camera.inverse().apply(points)
    in_front = x[:, 2] > 0
    pixels = frame.camera.project(np.where(in_front[:, None], x, [0.0, 0.0, 1.0]))
    inside = ((pixels >= 0) & (pixels < (frame.camera.width_px, frame.camera.height_px))).all(axis=1)
    return float((in_front & inside).mean())


if __name__ == "__main__":
    main()
