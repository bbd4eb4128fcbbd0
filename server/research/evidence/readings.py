"""Planted mistakes of poses and intrinsics: which are named, by the share of exceptions of `method.pairs.readings`.

Eight photographs of each scene, near one another and farther apart, are given as they are and with one planted mistake.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from unittest.mock import patch

import numpy as np

from mapless.geometry import Array, Camera, Quaternion, RigidTransform, Similarity, rotation_from_vector
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import make_extractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.pairs.readings import alignment, errors, explanation, repeats, rounding, sessions, verdict
from mapless_server.method.pairs.readings.errors import (
    MatchedPair,
    Views,
    consistent,
    distinct_matches,
    errors_of,
)
from mapless_server.method.pairs.readings.verdict import Verdict, judge, suspects_of
from mapless_tools.ingest.formats.cameras import read_folder
from research.places import Scenes

from .page import Measurement, Row

PHOTOGRAPHS = 8
SUFFIXES = (".jpg", ".jpeg", ".png")
MODULES = (alignment, explanation, repeats, rounding, sessions, verdict)
"""The modules that use the share."""
SHARES = (0.15, 0.2, 0.25, 0.3, 0.4)

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
    pairs = [
        MatchedPair(ends, consistent(views[ends[0]].view, views[ends[1]].view, matches)) for ends, matches in found
    ]
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


def _posed(views: Views, change: Callable[[RigidTransform], RigidTransform]) -> Views:
    return {i: replace(it, world_from_camera=change(it.world_from_camera)) for i, it in views.items()}


def _with_poses(views: Views, poses: Mapping[int, RigidTransform]) -> Views:
    return {i: replace(it, world_from_camera=poses.get(i, it.world_from_camera)) for i, it in views.items()}


def _filmed(views: Views, change: Callable[[Camera], Camera]) -> Views:
    return {i: replace(it, view=replace(it.view, camera=change(it.view.camera))) for i, it in views.items()}


def _turned(pose: RigidTransform, axes: Array) -> RigidTransform:
    return RigidTransform(pose.rotation @ axes, pose.translation)


def _reordered(pose: RigidTransform) -> RigidTransform:
    q = pose.quaternion()
    return RigidTransform(Quaternion(q.w, q.x, q.y, q.z).matrix(), pose.translation)


def _focal(camera: Camera, focal_px: float) -> Camera:
    return replace(camera, focal_x_px=focal_px, focal_y_px=focal_px)


def _places(scenes: Scenes) -> Iterator[Place]:
    """Eight photographs of each scene, in two spacings."""
    for name in scenes.names:
        frames = scenes.dataset(name).frames
        count = len(frames) if all(it.image_path.suffix.lower() in SUFFIXES for it in frames) else 0
        steps = dict.fromkeys((1, min(20, count // PHOTOGRAPHS)))
        for step in steps if count >= PHOTOGRAPHS else ():
            yield read_place(scenes.folder / name, step)


def _rows(folder: Path) -> Iterator[Row]:
    places = list(_places(Scenes(folder)))
    planted = [(it, place.matched) for place in places for it in planted_in(place)]
    right = [(it, matched) for it, matched in planted if it.words is None]
    wrong = [(it, matched) for it, matched in planted if it.words is not None]
    for share in SHARES:
        with ExitStack() as stack:
            for module in MODULES:
                stack.enter_context(patch.object(module, "FEW_SHARE", share))
            named = sum(it.is_named(judge(it.views, matched)) for it, matched in wrong)
            blamed = sum(not it.is_named(judge(it.views, matched)) for it, matched in right)
        yield {
            "share of exceptions": f"**{share:g}**" if share == errors.FEW_SHARE else f"{share:g}",
            f"named of {len(wrong)} mistakes": named,
            f"of {len(right)} right scenes: something named": blamed,
        }


def moved(views: Views, i: int) -> Views:
    """One photograph is turned by some degrees, and moved by about a tenth of the extent."""
    random, pose = np.random.default_rng(i), views[i].world_from_camera
    extent = np.ptp([it.world_from_camera.translation for it in views.values()], axis=0).max()
    turn = rotation_from_vector(np.radians(random.normal(0.0, 3.0, 3)))
    shift = random.normal(0.0, 0.1 * extent, 3)
    return _with_poses(views, {i: RigidTransform(turn @ pose.rotation, pose.translation + shift)})


def _suspects(folder: Path) -> Iterator[Row]:
    """Poses as they are, and with every third photograph's wrong, one at a time."""
    places = list(_places(Scenes(folder)))
    right = [errors_of(it.views, it.matched) for it in places]
    wrong = [(i, errors_of(moved(it.views, i), it.matched)) for it in places for i in list(it.views)[::3]]
    wrong = [(i, its) for i, its in wrong if any(i in it.pair for it in its)]
    for share in (0.01, 0.02, 0.025, 0.03, 0.04, 0.05):
        with patch.object(verdict, "RIGHT_BAD_SHARE", share):
            named = [(i, suspects_of(its)) for i, its in wrong]
            accused = sum(bool(suspects_of(its)) for its in right)
        yield {
            "share": f"**{share:g}**" if share == verdict.RIGHT_BAD_SHARE else f"{share:g}",
            f"of {len(right)} right scenes: a photograph named": accused,
            f"of {len(wrong)} wrong poses: named": sum(i in found for i, found in named),
            "others named beside": sum(bool({*found} - {i}) for i, found in named),
        }


MEASUREMENTS = {"readings": Measurement(_rows), "suspects": Measurement(_suspects)}
