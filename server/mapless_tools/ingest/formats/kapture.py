"""kapture 1.x (NAVER LABS Europe), and LaMAR's Capture sessions, which have its tables with inverse poses.

kapture: `sensors/sensors.txt` (id, name, type, model, width, height, parameters), `sensors/trajectories.txt`
(timestamp, device, qw qx qy qz tx ty tz of device_from_world), `sensors/rigs.txt` (rig, device, sensor_from_rig; rigs
may hold rigs), `sensors/records_camera.txt` (timestamp, sensor, path in `sensors/records_data`). Camera models, axes
and the corner from which principal points count are COLMAP's. `sensors/records_depth.txt` (timestamp, sensor, path in
`sensors/records_data`) has depths: float32 metres, little-endian, row by row, 0 where there is none, of sensors of the
type depth, which have a camera's parameters. A photograph's depth has its timestamp; of several, such as a raw one and
one that is registered to the photograph, it is that of the nearest sensor. All else is ignored. (kapture's
kapture_format, and the tools of its library that write depths.)

Capture: a session's folder with `sensors.txt`, `rigs.txt` (rig_from_sensor), `trajectories.txt` (world_from_device),
`images.txt` (paths in `raw_data`), and perhaps `proc/alignment_trajectories.txt`, which has the poses in the world that
all sessions share.
"""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mapless.depth import DepthSensor
from mapless.geometry import Camera, RigidTransform
from mapless.masks import FOLDER as MASKS
from mapless.provenance import Provenance, provenance_from_json
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, read_place

from .collecting import Collector, ReadOptions, filled_lines, rotation_of, text_lines
from .colmap.cameras import PARAMETERS, ColmapCamera
from .masks import with_own_masks

PROPERTIES = "# mapless: "
"""Begins a comment of our own exports in sensors.txt: what kapture has no field for, as JSON."""
_SENSORS = {it.value for it in DepthSensor}
_MAX_NESTED = 10  # rigs in rigs, as kapture's own library


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / "sensors" / "sensors.txt").is_file() or all(
        (path / name).is_file() for name in ("sensors.txt", "images.txt")
    )


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    is_capture = not (path / "sensors" / "sensors.txt").is_file()
    if is_capture and not fits(path):
        raise ValueError(
            f"{path} holds no sensors/sensors.txt; name one kapture of several, such as its mapping folder"
        )
    tables = path if is_capture else path / "sensors"
    records = tables / ("images.txt" if is_capture else "records_camera.txt")
    collector = Collector(tables / ("raw_data" if is_capture else "records_data"), options.depths)
    trajectories = tables / "trajectories.txt"
    aligned = path / "proc" / "alignment_trajectories.txt"
    if is_capture and aligned.is_file():
        trajectories = aligned
        collector.notes.append(f"poses are those of {aligned.relative_to(path)}, in the world of all sessions")
    properties = _properties(tables / "sensors.txt")
    cameras = _cameras(tables / "sensors.txt", "camera")
    poses = _Poses(trajectories, tables / "rigs.txt", is_capture)
    depths = _Depths(collector, tables, poses)
    for place, (timestamp, sensor, image) in _rows(records, 3):
        with collector.attempt(f"{place} ({image})"):
            if sensor not in cameras:
                raise ValueError(f"sensor {sensor!r} is no camera of sensors.txt")
            camera, pose = cameras[sensor].camera(), poses.world_from_device(timestamp, sensor)
            known = _provenance(properties, image)
            collector.add(image, camera, pose, provenance=known, depth=depths.at(timestamp, camera, pose))
    is_metric = is_capture or bool(properties.get("metric", False))
    dataset = collector.dataset(path.resolve().name, "kapture", metric=is_metric, source=f"kapture {path.name}")
    dataset = with_own_masks(dataset, collector.folder, path / MASKS)  # of our own exports
    datum, down = read_place(tables / "sensors.txt", properties)
    return replace(dataset, datum=datum, down_in_world=down)


def _properties(file: Path) -> dict[str, Any]:
    """Properties of the scene in our own exports; ValueError for another version of the format."""
    lines = [line for _, line in text_lines(file)]
    version = re.match(r"#\s*kapture format:\s*(\S+)", lines[0]) if lines else None
    if version is not None and not version[1].startswith("1."):
        raise ValueError(f"{file}:1: kapture format {version[1]} is not known, only 1.x")
    for line in lines:
        if line.startswith(PROPERTIES):
            with suppress(ValueError, RecursionError):
                content = json.loads(line.removeprefix(PROPERTIES))
                return content if isinstance(content, dict) else {}
    return {}


def _provenance(properties: Mapping[str, Any], image: str) -> Provenance:
    """How the pose of an image of our own exports is known; ValueError names what is wrong."""
    content = properties.get("provenance", {})
    try:
        return provenance_from_json(content.get(image) if isinstance(content, Mapping) else content)
    except ValueError as error:
        raise ValueError(f"provenance: {error}") from None


def _cameras(file: Path, wanted_kind: str) -> dict[str, ColmapCamera]:
    """Reads the sensors of a kind by id; a camera of an unknown model is refused only with its images."""
    cameras = {}
    for place, (sensor, _, kind, *parameters) in _rows(file, 3):
        if kind != wanted_kind:
            continue
        if len(parameters) < 3:
            raise ValueError(f"{place}: a camera has a model, width and height, found {len(parameters)} parameters")
        model = parameters[0]
        numbers = finite_numbers(parameters[1:], f"{place}: parameters of the camera").tolist()
        width_px, height_px = map(int, numbers[:2])
        wanted = PARAMETERS.get(model)
        if wanted is not None and len(numbers) != 2 + len(wanted):
            raise ValueError(f"{place}: {model} has parameters w h {' '.join(wanted)}, found {len(numbers)} numbers")
        cameras[sensor] = ColmapCamera(sensor, model, width_px, height_px, numbers[2:])
    return cameras


@dataclass(frozen=True)
class _Row:
    """A pose in a file's form, read when it is needed, so that a damaged pose affects only its own images."""

    place: str
    words: list[str]
    is_inverse: bool

    def pose(self) -> RigidTransform:
        if "" in self.words:
            raise ValueError(f"{self.place}: the pose is not complete")
        numbers = finite_numbers(self.words, f"{self.place}: the pose", (7,))
        given = RigidTransform(rotation_of(numbers[:4], self.place), numbers[4:])
        return given.inverse() if self.is_inverse else given


class _Poses:
    """Poses of devices, from their own trajectories and those of the rigs they are mounted on."""

    def __init__(self, trajectories: Path, rigs: Path, is_capture: bool) -> None:
        self._file = trajectories
        self._world_from_device: dict[tuple[int, str], _Row] = {}
        self._mounts: dict[str, list[tuple[str, _Row]]] = {}
        for place, (timestamp, device, *words) in _rows(trajectories, 9):
            self._world_from_device[_whole(timestamp, place), device] = _Row(place, words[:7], not is_capture)
        if rigs.is_file():
            for place, (rig, device, *words) in _rows(rigs, 9):
                self._mounts.setdefault(device, []).append((rig, _Row(place, words[:7], not is_capture)))

    def world_from_device(self, timestamp: str, device: str) -> RigidTransform:
        """The pose of a device at a time; ValueError if neither it nor a rig it is mounted on has one."""
        pose = self._found(_whole(timestamp, "timestamp"), device, _MAX_NESTED)
        if pose is None:
            mounted = (
                f", nor do its rigs ({', '.join(rig for rig, _ in self._mounts[device])})"
                if device in self._mounts
                else ""
            )
            raise ValueError(f"pose: {self._file.name} has none of {device!r} at {timestamp}{mounted}")
        return pose

    def _found(self, timestamp: int, device: str, depth: int) -> RigidTransform | None:
        if (timestamp, device) in self._world_from_device:
            return self._world_from_device[timestamp, device].pose()
        if depth:
            for rig, mount in self._mounts.get(device, ()):
                world_from_rig = self._found(timestamp, rig, depth - 1)
                if world_from_rig is not None:
                    return world_from_rig.compose(mount.pose())
        return None


class _Depths:
    """Depths by their time; none without records of them."""

    def __init__(self, collector: Collector, tables: Path, poses: _Poses) -> None:
        self._collector, self._poses = collector, poses
        self._paths: dict[int, list[tuple[str, str]]] = {}
        file, sensors = tables / "records_depth.txt", tables / "sensors.txt"
        if collector.depths.no_depth or not file.is_file():
            return
        self._cameras = _cameras(sensors, "depth")
        self._names = {sensor: name for _, (sensor, name, *_) in _rows(sensors, 3)}
        for place, (timestamp, sensor, path, *_) in _rows(file, 3):
            with collector.attempt_depth(path):
                self._paths.setdefault(_whole(timestamp, place), []).append((sensor, path))

    def at(self, timestamp: str, photo: Camera, world_from_camera: RigidTransform) -> DepthFile | None:
        """The depth of a photograph of this time, camera and pose."""
        found: list[DepthFile] = []
        for sensor, path in self._paths.get(_whole(timestamp, "timestamp"), ()):
            with self._collector.attempt_depth(path):
                found.append(self._depth(timestamp, sensor, path, world_from_camera))
        if not found:
            return None
        return self._collector.depth(min(found, key=_apart_m), (photo.width_px, photo.height_px))

    def _depth(self, timestamp: str, sensor: str, path: str, world_from_camera: RigidTransform) -> DepthFile:
        if sensor not in self._cameras:
            raise ValueError(f"sensor {sensor!r} is no depth sensor of sensors.txt")
        world_from_sensor = self._poses.world_from_device(timestamp, sensor)
        camera_from_sensor = world_from_camera.inverse().compose(world_from_sensor)
        camera, name = self._cameras[sensor].camera(), self._names[sensor]
        kind = DepthSensor(name) if name in _SENSORS else DepthSensor.UNKNOWN  # of our own exports
        size = camera.width_px, camera.height_px
        return DepthFile(Path(path), 1.0, kind, camera, camera_from_sensor, size=size)


def _apart_m(depth: DepthFile) -> float:
    pose = depth.camera_from_depth_camera
    return 0.0 if pose is None else float(np.linalg.norm(pose.translation))


def _whole(text: str, what: str) -> int:
    try:
        return int(text[:20])
    except ValueError:
        raise ValueError(f"{what}: a timestamp is a whole number, is {text!r}") from None


def _rows(file: Path, least: int) -> Iterator[tuple[str, list[str]]]:
    """Yields rows of a table with their position; ValueError if it cannot be read or a row is too short."""
    for number, line in filled_lines(file):
        words = [word.strip() for word in line.split(",")]
        if len(words) < least:
            raise ValueError(f"{file}:{number}: expected at least {least} values with commas, found {len(words)}")
        yield f"{file.name}:{number}", words
