"""The depth of frames in `cameras.json`.

A frame's ``depth`` is the path of a PNG of 16 bits, or of float32 values (``.f32``, little-endian, row by row). What is
said of it, in the frame or for all frames beside ``frames``: ``depth_unit_m`` (0.001 for millimetres), ``depth_sensor``
(of `DepthSensor`) or ``depth_noise`` (of `DepthNoise`), ``depth_K`` with ``depth_width``, ``depth_height``,
``depth_dist`` and ``depth_lens`` if another camera than the photograph's saw it, ``camera_from_depth_camera`` (4x4)
where that is elsewhere, and ``depth_confidence`` (path of a PNG of 8 bits) with ``depth_min_confidence``.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from mapless.cameras import camera_of_frame
from mapless.depth import DepthImage, DepthNoise, DepthSensor
from mapless.geometry import Camera, RigidTransform
from mapless.lenses import DEFAULT_LENS_MODEL, lens_model_of
from mapless_tools.dataset import DepthFile, finite_numbers, named, path_in

FOLDER = "depth"
"""Where exports put them."""
FLOAT32 = ".f32"


@dataclass(frozen=True, eq=False)
class WrittenDepth:
    """The depth of an image in a layout's file of this path; `image` has no values, and of these the size.

    `confidence` is the path of its confidence, empty without one.
    """

    path: str
    image: DepthImage
    confidence: str = ""


_OF_CAMERA = ("width", "height", "K", "dist", "lens")


def depth_of_frame(folder: Path, entry: Mapping[str, Any], beside: Mapping[str, Any]) -> DepthFile | None:
    """The depth of an entry of `frames`, if it has one; `beside` is said of all. ValueError names a wrong field."""
    if entry.get("depth") is None:
        return None
    said = {**beside, **entry}
    with named("depth"):
        path = path_in(folder, entry["depth"])
    return DepthFile(
        path,
        _unit_m(said),
        _sensor(said),
        _camera(said),
        _read(said, "camera_from_depth_camera", _pose),
        _read(said, "depth_confidence", lambda it: path_in(folder, it)),
        _integer(said, "depth_min_confidence", 1),
        _read(said, "depth_noise", _noise),
        _size(said, entry) if path.suffix == FLOAT32 else None,
    )


def depth_entry(written: WrittenDepth) -> dict[str, Any]:
    """The entries of a frame for its depth."""
    depth = written.image
    entry: dict[str, Any] = {"depth": written.path, "depth_unit_m": depth.unit_m}
    entry["depth_sensor"] = depth.sensor.value
    if depth.size is not None:
        entry["depth_width"], entry["depth_height"] = depth.size
    if depth.camera is not None:
        entry |= {f"depth_{field}": value for field, value in _camera_entry(depth.camera).items()}
    if depth.camera_from_depth_camera is not None:
        entry["camera_from_depth_camera"] = depth.camera_from_depth_camera.matrix().tolist()
    if written.confidence:
        entry |= {"depth_confidence": written.confidence, "depth_min_confidence": depth.min_confidence}
    if depth.noise is not None:
        entry["depth_noise"] = asdict(depth.noise)
    return entry


def _read(said: Mapping[str, Any], field: str, read: Callable[[Any], Any]) -> Any:
    if said.get(field) is None:
        return None
    with named(field):
        return read(said[field])


def _unit_m(said: Mapping[str, Any]) -> float:
    value = said.get("depth_unit_m")
    if value is None:
        raise ValueError("depth_unit_m is missing: 0.001 for millimetres")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"depth_unit_m must be a number, is {value!r}: 0.001 for millimetres")
    return float(finite_numbers(value, "depth_unit_m", ()))


def _sensor(said: Mapping[str, Any]) -> DepthSensor:
    value, kinds = said.get("depth_sensor", DepthSensor.UNKNOWN.value), [it.value for it in DepthSensor]
    if value not in kinds:
        raise ValueError(f"depth_sensor must be one of {', '.join(kinds)}, is {value!r}")
    return DepthSensor(value)


def _noise(numbers: object) -> DepthNoise:
    names = [it.name for it in fields(DepthNoise)]
    if not isinstance(numbers, dict) or not numbers.keys() <= set(names):
        raise ValueError(f"must be an object of {', '.join(names)}, is {numbers!r}")
    return DepthNoise(**{name: float(finite_numbers(value, name, ())) for name, value in numbers.items()})


def _pose(matrix: object) -> RigidTransform:
    return RigidTransform.from_matrix(finite_numbers(matrix, "it", (4, 4)))


def _size(said: Mapping[str, Any], entry: Mapping[str, Any]) -> tuple[int, int]:
    return _integer(said, "depth_width", entry["width"]), _integer(said, "depth_height", entry["height"])


def _integer(said: Mapping[str, Any], field: str, default: int) -> int:
    """An integer, or the default if it is missing or null; ValueError, naming the field, for another value."""
    value = said.get(field)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{field}: must be an integer, is {value!r}")
    return value


def _camera(said: Mapping[str, Any]) -> Camera | None:
    """The depth camera, None if it is the photograph's; its size is the photograph's unless it is given."""
    if said.get("depth_K") is None:
        return None
    with named("depth_K"):
        size = {side: said[side] for side in ("width", "height") if side in said}
        named_so = {it: said[f"depth_{it}"] for it in _OF_CAMERA if said.get(f"depth_{it}") is not None}
        return camera_of_frame(size | named_so)


def _camera_entry(camera: Camera) -> dict[str, Any]:
    entry: dict[str, Any] = {"width": camera.width_px, "height": camera.height_px, "K": camera.matrix().tolist()}
    if (lens := camera.distortion) is not None:
        entry["dist"] = list(vars(lens).values())
        if (model := lens_model_of(lens)) != DEFAULT_LENS_MODEL:
            entry["lens"] = model
    return entry
