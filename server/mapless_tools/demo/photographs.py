"""The demo's photographs: the project's own ones of a room, or a folder of real ones."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless import Camera, NewReference, RigidTransform
from mapless.geometry import Array
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder

ROOM = Path(__file__).with_name("room")
MAX_FRAMES = 60
"""Frames that are used of a longer real sequence, evenly spread: enough to judge, in a minute."""
QUERY_EVERY = 3


@dataclass(frozen=True, eq=False)
class Photograph:
    """An encoded photograph with its true pose."""

    name: str
    data: bytes
    camera: Camera
    world_from_camera: RigidTransform

    def reference(self, reference_id: str = "") -> NewReference:
        """The photograph as a reference to store, by its name or another id."""
        return NewReference(reference_id or self.name, self.data, self.camera, self.world_from_camera)


@dataclass(frozen=True, eq=False)
class Outline:
    """Edges of a room and its larger furniture, world, metres: (E, 2, 3), all and those visible in each query."""

    edges: Array
    visible_edges: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Place:
    """References and queries of one place; none is in both. The outline is None if it is not known."""

    title: str
    references: Sequence[Photograph]
    queries: Sequence[Photograph]
    metric: bool
    outline: Outline | None = None


def place_of(data: Path | None) -> Place:
    """A folder of real photographs, or the project's own room if it is None; ValueError for a malformed folder."""
    return room() if data is None else split_folder(data)


def room() -> Place:
    """The rendered room: sixteen references from a walk around its table, eight queries from elsewhere."""
    photographs = [_read(frame) for frame in read_folder(ROOM).frames]
    references = [it for it in photographs if it.name.startswith("reference")]
    queries = [it for it in photographs if it.name.startswith("query")]
    content = json.loads((ROOM / "outline.json").read_text("utf-8"))
    visible = {name: np.array(edges) for name, edges in content["visible_edges"].items()}
    outline = Outline(np.array(content["edges"]), visible)
    return Place("a room rendered from nothing but code", references, queries, metric=True, outline=outline)


def depth_map_m(name: str) -> NDArray[np.float32]:
    """True depths (180, 240) of a photograph of the room, metres along the optical axis at pixel centres."""
    depth_mm = cv2.imread(str(ROOM / "depth" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
    if depth_mm is None:
        raise ValueError(f"the room has no photograph {name!r}")
    return np.asarray(depth_mm / 1000, np.float32)


def split_folder(path: Path) -> Place:
    """A folder of real photographs: every third frame is a query, the others are references."""
    dataset = read_folder(path)
    count = len(dataset.frames)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_FRAMES)).round().astype(int))
    photographs = [_read(dataset.frames[i]) for i in chosen]
    title = f"{dataset.name}, every {QUERY_EVERY}rd frame a query"
    if len(chosen) < count:
        title += f", {len(chosen)} of {count} frames used"
    queries = photographs[QUERY_EVERY // 2 :: QUERY_EVERY]
    return Place(title, [it for it in photographs if it not in queries], queries, dataset.metric)


def _read(frame: Frame) -> Photograph:
    return Photograph(frame.name, frame.image_path.read_bytes(), frame.camera, frame.world_from_camera)
