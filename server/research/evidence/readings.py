"""Planted mistakes of poses and intrinsics that are named, by the constants of `method.pairs.readings`.

Twelve photographs of a place, near enough to share what they show, are given as they are and with one planted mistake.
A constant is changed in all modules that have it, one at a time.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from mapless.geometry import Camera, Quaternion, RigidTransform, Similarity, rotation_from_vector
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.pairs.readings.errors import MatchedPair, Views, consistent, distinct_matches
from mapless_server.method.pairs.readings.verdict import Verdict, judge
from mapless_tools.ingest.formats.cameras import read_folder

READINGS = "mapless_server.method.pairs.readings"
PHOTOGRAPHS = 12
PLACES: Mapping[str, int] = {
    "herz-jesus-P8": 1,
    "fountain-P11": 1,
    "chess-king": 1,
    "office-lockers": 2,
    "meeting-room": 2,
    "7scenes-redkitchen-seq01-first600": 20,
    "tum-fr3-office": 1,
    "euroc-v101-drone": 2,
}
"""The folders, and every how manieth frame is taken."""

OTHER_WORLD = Similarity(1.7, rotation_from_vector(np.array([0.3, 0.8, -0.2])), np.array([3.0, -1.0, 2.0]))


@dataclass(frozen=True)
class Place:
    """Posed views of a folder, by number, and their matched pairs."""

    name: str
    views: Views
    matched: Sequence[MatchedPair]


@dataclass(frozen=True)
class Planted:
    """A mistake, and whether a verdict on it is right: words that must be in its explanation; None for no mistake."""

    name: str
    views: Views
    words: str | None

    def is_named(self, verdict: Verdict) -> bool:
        """Whether the verdict names the mistake; without one, whether it finds nothing wrong."""
        if self.words is None:
            return not (verdict.is_wrong or verdict.suspects or verdict.same_pose or verdict.same_photograph)
        return self.words in verdict.explanation


def read_place(folder: Path, step: int) -> Place:
    """The first photographs, each so many frames after the one before."""
    extractor = make_extractor("sift")
    frames = read_folder(folder).frames[::step][:PHOTOGRAPHS]
    views = {}
    for i, frame in enumerate(frames):
        view = extractor.extract(decode_image(frame.image_path.read_bytes(), ImageLimits()), frame.camera)
        views[i] = PosedView(frame.name, frame.name, view, frame.world_from_camera)
    found = [((i, j), distinct_matches(views[i].view, views[j].view)) for i, j in combinations(views, 2)]
    pairs = [MatchedPair(ends, consistent(*(views[i].view for i in ends), matches)) for ends, matches in found]
    return Place(folder.name, views, [it for it in pairs if len(it.matches)])


def planted_in(place: Place) -> Iterator[Planted]:
    """The place as it is, and with each mistake."""
    views = place.views
    yield Planted("none", views, None)
    y_up = np.diag([1.0, -1.0, -1.0])
    yield Planted("inverse poses", _posed(views, RigidTransform.inverse), "camera_from_world")
    yield Planted("OpenGL's axes", _posed(views, lambda it: _turned(it, y_up)), "OpenGL")
    yield Planted("quaternion's order", _posed(views, _reordered), "quaternions are")
    yield Planted(
        "transposed rotations", _posed(views, lambda it: RigidTransform(it.rotation.T, it.translation)), "transposed"
    )
    yield Planted("focal lengths 0.6", _filmed(views, lambda it: _focal(it, 0.6 * it.focal_x_px)), "focal length")
    yield Planted("K not set", _filmed(views, lambda it: _focal(it, 1.0)), "K was not set")
    some = {i: _turned(it.world_from_camera, y_up) for i, it in views.items() if i % 4 == 0}
    yield Planted("OpenGL's axes of some", _with_poses(views, some), "OpenGL")
    moved = {i: OTHER_WORLD.transform_pose(it.world_from_camera) for i, it in views.items() if i >= len(views) / 2}
    yield Planted("two sessions", _with_poses(views, moved), "fits with")
    digits = int(np.floor(-np.log10(np.ptp([it.world_from_camera.translation for it in views.values()], axis=0).max())))
    rounded = _posed(views, lambda it: RigidTransform(it.rotation, it.translation.round(digits + 1)))
    yield Planted("rounded positions", rounded, "positions are rounded")


def _posed(views: Views, change) -> Views:  # type: ignore[no-untyped-def]
    return {i: replace(it, world_from_camera=change(it.world_from_camera)) for i, it in views.items()}


def _with_poses(views: Views, poses: Mapping[int, RigidTransform]) -> Views:
    return {i: replace(it, world_from_camera=poses.get(i, it.world_from_camera)) for i, it in views.items()}


def _filmed(views: Views, change) -> Views:  # type: ignore[no-untyped-def]
    return {i: replace(it, view=replace(it.view, camera=change(it.view.camera))) for i, it in views.items()}


def _turned(pose: RigidTransform, axes: np.ndarray) -> RigidTransform:
    return RigidTransform(pose.rotation @ axes, pose.translation)


def _reordered(pose: RigidTransform) -> RigidTransform:
    q = pose.quaternion()
    return RigidTransform(Quaternion(q.w, q.x, q.y, q.z).matrix(), pose.translation)


def _focal(camera: Camera, focal_px: float) -> Camera:
    return replace(camera, focal_x_px=focal_px, focal_y_px=focal_px)


def named(places: Sequence[Place]) -> dict[str, list[str]]:
    """The places where each mistake is named."""
    found: dict[str, list[str]] = {}
    for place in places:
        for it in planted_in(place):
            found.setdefault(it.name, [])
            if it.is_named(judge(it.views, place.matched)):
                found[it.name].append(place.name)
    return found
