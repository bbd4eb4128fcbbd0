"""Measures what the depth of references is worth, on folders with depth (`cameras.json`).

    python -m research.depth_places FOLDER... [--features auto] [--pairs 40] [--queries 16] [--json FILE]

One reference with depth: photographs in which half of its depth is visible are localized by it alone; a point is
visible that is inside the photograph and not behind a depth that was measured with the photograph. Several: 3, 5
and 10 references, evenly spread, with their depth and without, and photographs between them. Elsewhere: photographs of
the other folders. An answer is wrong if it is off by more than 5 % of the median depth.

The kind of a sensor is stated where the folder is known, as by people who know their camera. The poses of `lidar-desk`
are ARKit's, whose scale is not the sensor's: there errors of one reference, but not their radii, are after the common
scale that its README states. The engine works in this process. Features are kept in the folder of the cache, between
runs.
"""

import argparse
import asyncio
import hashlib
import itertools
import pickle
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.depth import DepthSensor
from mapless.geometry import Camera
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Photo, Query, Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.images import ImageLimits, decode_depth, decode_image
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.method.features.extractors import FeatureExtractor, Mirrors
from mapless_server.method.features.views import Ignored, PosedView, View
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.structure.measured_depth import MeasuredDepth
from mapless_server.scenes import ANYWHERE
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.serve.features import make_tiers
from mapless_server.settings import load_settings
from mapless_server.store import NewReference, Store
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.ingest.formats.cameras import read_folder
from research.all_features import describe_all

from .depth_tables import Outcome, alone_rows, several_rows, written

MIN_VISIBLE = 0.5
COUNTS = (3, 5, 10)
STEP = 37
"""Every so many pixels of a depth are projected."""
HIDDEN_SHARE = 0.05
"""A point is hidden if it is farther by a larger share than the depth that was measured there."""
CACHE = Path(tempfile.gettempdir()) / "mapless-depth-places"
SENSORS = {
    "tum-teddy": DepthSensor.STRUCTURED_LIGHT,
    "kinect-kitchen": DepthSensor.STRUCTURED_LIGHT,
    "lidar-desk": DepthSensor.PHONE_LIDAR,
    "realsense-robot": DepthSensor.STEREO,
}
SCALES = {"lidar-desk": 0.97}
"""Scale of the poses by that of the depths."""
LIMIT_S = 600.0
WITH, WITHOUT = SceneKey("with"), SceneKey("without")


def main() -> None:
    """Prints the tables as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--features", default="auto")
    parser.add_argument("--pairs", type=int, default=40, help="of one reference and a photograph, a folder")
    parser.add_argument("--queries", type=int, default=16, help="photographs for several references, a folder")
    parser.add_argument("--counts", type=int, nargs="*", default=list(COUNTS))
    parser.add_argument("--elsewhere", type=int, default=10, help="photographs of other folders, a folder")
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--json", type=Path, help="file to which each outcome is appended")
    arguments = parser.parse_args()
    found = list[Outcome]()
    for folder in arguments.folders:
        others = [it for it in arguments.folders if it != folder]
        with closing(DepthPlace(folder, arguments.features, arguments.cache)) as place:
            for outcome in place.outcomes(arguments.pairs, arguments.queries, arguments.counts):
                found.append(written(outcome, arguments.json))
            for outcome in place.elsewhere(others, arguments.elsewhere):
                found.append(written(outcome, arguments.json))
    print(*alone_rows(found), "", *several_rows(found), sep="\n")


class DepthFrames:
    """Frames with depth: which see the same."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self._depths = [_measured(it) if it.depth else None for it in frames]
        self._points = [_points(it, depth) for it, depth in zip(frames, self._depths, strict=True)]

    def median_m(self, i: int) -> float:
        """Median depth of a frame; 0 without depth."""
        return self._points[i][1]

    def pairs(self, count: int) -> Iterator[tuple[int, int]]:
        """At most so many pairs of a reference and a photograph that shows half of it, in a random but fixed order."""
        indices = range(len(self._frames))
        chosen = [(i, j) for i in indices for j in indices if i != j]
        np.random.default_rng(0).shuffle(chosen)
        seen = ((i, j) for i, j in chosen if self._frames[i].depth and self._visible_share(i, j) >= MIN_VISIBLE)
        yield from itertools.islice(seen, count)

    def _visible_share(self, i: int, j: int) -> float:
        """Share of a frame's points that another one's photograph shows."""
        camera, x = self._frames[j].camera, self._frames[j].world_from_camera.inverse().apply(self._points[i][0])
        in_front = x[:, 2] > 0
        pixels = camera.project(np.where(in_front[:, None], x, [0.0, 0.0, 1.0]))
        inside = in_front & ((pixels >= 0) & (pixels < (camera.width_px, camera.height_px))).all(axis=1)
        measured = self._depths[j]
        if measured is None:
            return float(inside.mean())
        height, width = measured.depth.shape
        column, row = np.rint(measured.camera.project(x[inside])).astype(int).T
        there = measured.depth[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
        return float((~(x[inside, 2] > (1 + HIDDEN_SHARE) * there)).sum() / len(x))


class DepthPlace:
    """A folder whose frames are all stored, with their depth in one scene and without in another.

    Attributes:
        name: the folder's.
        frames: with the kind of their sensor.
        depths: which of them see the same.
    """

    def __init__(self, folder: Path, features: str, cache: Path) -> None:
        self.name, self.frames = folder.name, [known(it, folder.name) for it in read_folder(folder).frames]
        self._data = tempfile.TemporaryDirectory()
        self._loop = asyncio.new_event_loop()
        self._store = Store.open(Path(self._data.name))
        settings = load_settings({"data_dir": self._data.name, "features": features}).settings
        tiers = [with_cache(it, cache) for it in make_tiers(settings)]
        self._engine: QueueEngine = engine_over(self._store, tiers, EngineOptions(workers=1))
        self._loop.run_until_complete(self._add())
        self.depths = DepthFrames(self.frames)

    def close(self) -> None:
        """Ends the engine and deletes the store."""
        self._loop.run_until_complete(self._engine.close())
        self._store.close()
        self._loop.close()
        self._data.cleanup()

    def outcomes(self, pairs: int, queries: int, counts: Sequence[int]) -> Iterator[Outcome]:
        """Those of one reference, and of several."""
        for i, j in self.depths.pairs(pairs):
            yield self.outcome("one", [i], self.frames[j], has_depth=True)
        for count in counts:
            few = np.unique(np.linspace(0, len(self.frames) - 1, count).round().astype(int)).tolist()
            others = [it for it in range(len(self.frames)) if it not in few]
            for j in np.unique(np.linspace(0, len(others) - 1, queries).astype(int)):
                for has_depth in (False, True):
                    yield self.outcome("several", few, self.frames[others[j]], has_depth)

    def elsewhere(self, others: Sequence[Path], count: int) -> Iterator[Outcome]:
        """Photographs of other folders, each by one reference."""
        for number in range(count if others else 0):
            frames = read_folder(others[number % len(others)]).frames
            i, j = (7 * number) % len(self.frames), (5 * number) % len(frames)
            if self.frames[i].depth:
                yield self.outcome("elsewhere", [i], frames[j], has_depth=True)

    async def _add(self) -> None:
        photos = [Photo(it.image_path.read_bytes(), it.camera, "image") for it in self.frames]
        described = describe_all(self._engine, photos)
        for scene in (WITH, WITHOUT):
            self._store.create_scene(scene)
            self._store.add_references(
                scene,
                [
                    NewReference(
                        f"r{i}",
                        photo.image,
                        photo.camera,
                        frame.world_from_camera,
                        it.views,
                        it.descriptors,
                        depth=frame.read_depth() if scene is WITH else None,
                    )
                    for i, (frame, photo, it) in enumerate(zip(self.frames, photos, described, strict=True))
                ],
            )

    def outcome(
        self, kind: str, references: Sequence[int], frame: Frame, has_depth: bool, *, photo_has_depth: bool = False
    ) -> Outcome:
        """That of a photograph, with its own depth or without, by references."""
        photo = Photo(frame.image_path.read_bytes(), frame.camera, "image")
        if photo_has_depth:
            photo = replace(photo, depth=frame.read_depth())
        ids = tuple(f"r{i}" for i in references)
        query = Query(WITH if has_depth else WITHOUT, ids, photo, ANYWHERE, 10, LocalizeOptions(), is_generic=True)
        result = self._loop.run_until_complete(self._engine.run(self._engine.query_job(query, _caller())))
        outcome, median_m = result.answer.outcome, float(np.median([self.depths.median_m(i) for i in references]))
        rung = next((it.rung for it in result.attempts if it.is_chosen), "")
        spent_s = sum(it.processor_s for it in result.attempts)
        about = self.name, kind, len(references), has_depth, frame.name, median_m
        if not isinstance(outcome, Localization):
            return Outcome(
                *about,
                None,
                None,
                None,
                None,
                f"{outcome.reason.value}: {outcome.message}",
                rung,
                spent_s,
                photo_has_depth,
            )
        error_m, error_deg = pose_error(frame.world_from_camera, outcome.world_from_camera)
        assert outcome.covariance is not None
        radii = accuracy_from_covariance(outcome.covariance)
        ratios = error_m / radii.position_68_m, error_m / radii.position_95_m
        if kind == "one":
            centre = self.frames[references[0]].world_from_camera.translation
            scaled = SCALES.get(self.name, 1.0) * (outcome.world_from_camera.translation - centre)
            error_m = float(np.linalg.norm(centre + scaled - frame.world_from_camera.translation))
        return Outcome(*about, error_m, error_deg, *ratios, "", rung, spent_s, photo_has_depth)


@dataclass(frozen=True)
class _Kept:
    """An extractor whose views are kept in a folder."""

    made: FeatureExtractor
    folder: Path

    @property
    def name(self) -> str:
        return self.made.name

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        if ignored is not None:
            return self.made.extract(image, camera, ignored)
        key = hashlib.sha256(image.tobytes() + repr((image.shape, camera, self.name)).encode()).hexdigest()
        file = self.folder / f"{key}.pickle"
        if not file.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            file.write_bytes(pickle.dumps(self.made.extract(image, camera)))
        view: View = pickle.loads(file.read_bytes())
        return view


class _KeptMirrors(_Kept):
    """The same for features that are known of a mirror image, too."""

    def mirrored(self, view: View) -> View:
        assert isinstance(self.made, Mirrors)
        return self.made.mirrored(view)


def with_cache(tier: Tier, folder: Path) -> Tier:
    """The tier with features that are kept in a folder."""
    is_mirroring = isinstance(tier.extractor, Mirrors)
    return replace(tier, extractor=(_KeptMirrors if is_mirroring else _Kept)(tier.extractor, folder))


def posed(place: str, frames: Sequence[Frame], tier: Tier) -> list[PosedView]:
    """Frames as references with their depth."""
    views = list[PosedView]()
    for frame in frames:
        view = tier.extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), frame.camera)
        depths = None if frame.depth is None else _measured(frame, as_seen=False).at_keypoints(view)
        views.append(PosedView(f"{place}-{frame.name}", frame.name, view, frame.world_from_camera, depths))
    return views


def _caller() -> Caller:
    return Caller(Flow("", "research"), time.monotonic() + LIMIT_S)


def known(frame: Frame, place: str) -> Frame:
    """The frame with its sensor."""
    if frame.depth is None or place not in SENSORS:
        return frame
    return replace(frame, depth=replace(frame.depth, sensor=SENSORS[place]))


def _measured(frame: Frame, as_seen: bool = True) -> MeasuredDepth:
    """A frame's depth, by default as its photograph's camera sees it."""
    assert frame.depth is not None
    image, photo = frame.depth.read(), frame.camera
    depth = decode_depth(image, (photo.width_px, photo.height_px), ImageLimits())
    camera = image.camera or photo.resized(*depth.shape[::-1])
    measured = MeasuredDepth(camera, depth, image.known_noise, image.camera_from_depth_camera)
    is_aligned = image.camera_from_depth_camera is None
    return measured if is_aligned or not as_seen else measured.seen_by(photo.pinhole())


def _points(frame: Frame, measured: MeasuredDepth | None) -> tuple[np.ndarray, float]:
    """Points (P, 3) of a frame's depth in the world, and its median; none without depth."""
    if measured is None:
        return np.empty((0, 3)), 0.0
    points = measured.points()[::STEP]
    return frame.world_from_camera.apply(points), float(np.median(points[:, 2]))


if __name__ == "__main__":
    main()
