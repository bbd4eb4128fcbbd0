"""Geometry types to messages and back; client and server share it.

Reading a message checks all bounds that the proto's comments state. A violation raises `FieldError`, which names the
field by its path in the request, "requests[3].reference.intrinsics.focal_x_px".
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime
from enum import Enum
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from . import names
from .geometry import Array, Camera, Quaternion, RigidTransform
from .lenses import LENS_MODELS, Distortion, lens_model_of, unknown_lens
from .v1 import geometry_pb2 as pb

T = TypeVar("T")
ProtoEnum = Any
"""A generated enum: the wrapper that has `Name`, `Value` and `values`."""

MIN_SIDE_PX, MAX_SIDE_PX = 32, 16384
MAX_DISTORTION = 100.0
MIN_FOCAL_PER_SIDE, MAX_FOCAL_PER_SIDE = 0.01, 100.0
"""A focal length, by the image's longer side: fields of view of 178 and 0.6 degrees."""
MAX_READOUT_S, MAX_SPEED_M_PER_S, MAX_TURN_DEG_PER_S = 0.2, 1000.0, 3600.0
"""Longest read-out of a rolling shutter, where the slowest sensors take 0.1 s, and largest speeds of its camera: an
aircraft's, and ten turns a second."""


class FieldError(ValueError):
    """A field of a message, by its path in the request, violates its contract."""

    def __init__(self, field: str, message: str) -> None:
        super().__init__(f"{field}: {message}")
        self.field = field


def joined(path: str, field: str) -> str:
    """The path of a field of the message at `path`; "" is the request itself."""
    return f"{path}.{field}" if path else field


def scene_id_from_name(name: str, field: str) -> str:
    """The id in "scenes/{scene}"; FieldError if it has another form."""
    return _parsed(names.parse_scene_name, name, field)


def reference_ids_from_name(name: str, field: str) -> tuple[str, str]:
    """The ids in "scenes/{scene}/references/{reference}"; FieldError if it has another form."""
    return _parsed(names.parse_reference_name, name, field)


def checked_id(value: str, field: str) -> str:
    """The id, unchanged; FieldError if it is invalid."""
    return _parsed(names.check_id, value, field)


def _parsed(parse: Callable[[str], T], text: str, field: str) -> T:
    try:
        return parse(text)
    except ValueError as error:
        raise FieldError(field, str(error)) from None


def require(value: object, kind: type, field: str, advice: str = "") -> None:
    """TypeError, with the argument's field and how to make such a value, for a value of another type."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIO" else "a"
        raise TypeError(f"{field} must be {article} {kind.__name__}, is {_kind(value)}{advice and f'; {advice}'}")


def listed(values: Iterable[T], kind: type[T], field: str) -> Iterator[tuple[str, T]]:
    """Items of a list, each with its field, "frames[2]"; TypeError for an item of another type, or for no list."""
    parts, missing = dataclasses.fields(kind), dataclasses.MISSING  # type: ignore[arg-type]  # kind is a dataclass
    wanted = [it.name for it in parts if it.default is missing and it.default_factory is missing]
    advice = f"one is made by {kind.__name__}({', '.join(wanted)})"
    if isinstance(values, str | bytes) or not isinstance(values, Iterable):
        raise TypeError(f"{field} must be a list of {kind.__name__}, is {_kind(values)}; {advice}")
    for i, value in enumerate(values):
        require(value, kind, f"{field}[{i}]", advice)
        yield f"{field}[{i}]", value


def set_numbers(message: Any, values: Mapping[str, object], path: str = "") -> None:
    """Sets numbers and truth values of a message.

    TypeError names the field of a value of another type, ValueError that of one that the field cannot hold.
    """
    for name, value in values.items():
        _set_number(message, name, value, path)


def _set_number(message: Any, name: str, value: object, path: str) -> None:
    field = message.DESCRIPTOR.fields_by_name[name]
    try:
        if isinstance(value, bool) and field.cpp_type != field.CPPTYPE_BOOL:
            raise TypeError
        setattr(message, name, value)
    except TypeError:
        others = {field.CPPTYPE_DOUBLE: "a number", field.CPPTYPE_BOOL: "True or False"}
        wanted = others.get(field.cpp_type, "a whole number")
        raise TypeError(f"{joined(path, name)} must be {wanted}, is {value!r}") from None
    except (ValueError, OverflowError):
        raise ValueError(f"{joined(path, name)} is out of the field's range, is {value}") from None


def set_time(timestamp: Any, time: datetime, field: str) -> None:
    """Sets a message's timestamp; TypeError, naming the field, for another type than a time."""
    require(time, datetime, field, "such as datetime.now(timezone.utc)")
    timestamp.FromDatetime(time)


def camera_to_message(camera: Camera, field: str = "camera") -> pb.CameraIntrinsics:
    """Message of a camera; TypeError, naming the field, if one is not a number, or for another type than a camera."""
    require(camera, Camera, field, "read_camera makes one of a file")
    message = pb.CameraIntrinsics()
    set_numbers(message, {name: value for name, value in vars(camera).items() if name != "distortion"}, field)
    if camera.distortion is not None:
        model = lens_model_of(camera.distortion)
        if not hasattr(message, model):
            raise unknown_lens(camera.distortion)
        of_model = getattr(message, model)
        of_model.SetInParent()  # also where all coefficients are zero
        for name, value in vars(camera.distortion).items():
            setattr(of_model, name, value)
    return message


def camera_from_message(message: pb.CameraIntrinsics, field: str) -> Camera:
    """Camera of a message.

    FieldError if a number is not finite or out of the range that geometry.proto states.
    """
    for side in ("width_px", "height_px"):
        value = getattr(message, side)
        if not MIN_SIDE_PX <= value <= MAX_SIDE_PX:
            raise FieldError(joined(field, side), f"must be {MIN_SIDE_PX} to {MAX_SIDE_PX}, is {value}")
    side_px = max(message.width_px, message.height_px)
    min_focal_px, max_focal_px = MIN_FOCAL_PER_SIDE * side_px, MAX_FOCAL_PER_SIDE * side_px
    for focal in ("focal_x_px", "focal_y_px"):
        value = getattr(message, focal)
        if not min_focal_px <= value <= max_focal_px:
            raise FieldError(joined(field, focal), f"must be {min_focal_px:g} to {max_focal_px:g}, is {value:g}")
    for principal, side_px in (("principal_x_px", message.width_px), ("principal_y_px", message.height_px)):
        value = getattr(message, principal)
        if not -side_px <= value <= 2 * side_px:
            raise FieldError(joined(field, principal), f"must be {-side_px} to {2 * side_px}, is {value:g}")
    pinhole = {it.name: getattr(message, it.name) for it in dataclasses.fields(Camera) if it.name != "distortion"}
    return Camera(**pinhole, distortion=_distortion_from_message(message, field))


def _distortion_from_message(message: pb.CameraIntrinsics, field: str) -> Distortion | None:
    kind = message.WhichOneof("distortion")
    if kind is None:
        return None
    lens = getattr(message, kind)
    coefficients = {name: getattr(lens, name) for name in lens.DESCRIPTOR.fields_by_name}
    for name, value in coefficients.items():
        if not abs(value) <= MAX_DISTORTION:
            raise FieldError(
                joined(field, f"{kind}.{name}"), f"must be at most {MAX_DISTORTION:g} in magnitude, is {value:g}"
            )
    found: Distortion = LENS_MODELS[kind](**coefficients)
    return found


def transform_to_message(target_from_source: RigidTransform, field: str = "a pose") -> pb.RigidTransform:
    """Message of a rigid transform, its quaternion with w >= 0; TypeError, naming the field, for another type."""
    require(target_from_source, RigidTransform, field, "RigidTransform.from_matrix makes one")
    q = target_from_source.quaternion()
    return pb.RigidTransform(
        rotation=pb.Quaternion(**vars(q)), translation_m=vector_to_message(target_from_source.translation)
    )


def transform_from_message(
    message: pb.RigidTransform, field: str, max_coordinate_m: float = math.inf
) -> RigidTransform:
    """Rigid transform of a message, its rotation normalized.

    FieldError if a part is missing or not finite, the quaternion's norm is not one, or a coordinate exceeds the
    maximum.
    """
    for part in ("rotation", "translation_m"):
        if not message.HasField(part):
            raise FieldError(joined(field, part), "is required")
    q = message.rotation
    try:
        rotation = Quaternion(q.x, q.y, q.z, q.w).matrix()
    except ValueError as error:
        raise FieldError(joined(field, "rotation"), str(error)) from None
    translation = vector_from_message(message.translation_m, joined(field, "translation_m"), max_coordinate_m)
    return RigidTransform(rotation, translation)


def vector_to_message(xyz: ArrayLike, name: str = "vector") -> pb.Vector3:
    """Message of a vector (3,); ValueError with its name if it is none."""
    vector = np.asarray(xyz, float)
    if vector.shape != (3,):
        raise ValueError(f"{name} must have three numbers, x, y and z, is {vector.tolist()}")
    x, y, z = vector.tolist()
    return pb.Vector3(x=x, y=y, z=z)


def vector_from_message(message: pb.Vector3, field: str, max_coordinate_m: float = math.inf) -> Array:
    """Coordinates (3,) in metres; FieldError if one is not finite or exceeds the maximum in magnitude."""
    for axis in ("x", "y", "z"):
        value = getattr(message, axis)
        if not math.isfinite(value):
            raise FieldError(joined(field, axis), f"must be finite, is {value}")
        if abs(value) > max_coordinate_m:
            raise FieldError(joined(field, axis), f"must be at most {max_coordinate_m:g} m in magnitude, is {value:g}")
    return np.array([message.x, message.y, message.z])


def _kind(value: object) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}".removeprefix("builtins.")


def enum_prefix(enum: ProtoEnum) -> str:
    """The common prefix of an enum's value names, "SCALE_STAGE_"."""
    return str(enum.Name(0)).removesuffix("UNSPECIFIED")


def value_name(enum: Any, number: int) -> str:
    """REJECTION_REASON_LOW_OVERLAP becomes "LOW_OVERLAP"; an unknown value, from a newer server, its number as text.

    `enum` is a descriptor.
    """
    names = enum.values_by_number
    prefix = names[0].name.removesuffix("UNSPECIFIED")
    return names[number].name.removeprefix(prefix) if number in names else str(number)


def enum_value(enum: ProtoEnum, value: str | Enum) -> Any:
    """The number of a value of an enum, given without prefix in small or capital letters; 0 for "".

    ValueError lists the values that the enum has.
    """
    prefix = enum_prefix(enum)
    written = str(value.value if isinstance(value, Enum) else value)
    if not written:
        return 0
    known = [name.removeprefix(prefix).lower() for name in enum.keys()[1:]]
    if written.lower() not in known:
        raise ValueError(f"{enum.DESCRIPTOR.name} must be one of {', '.join(known)}, is {written!r}")
    return enum.Value(prefix + written.upper())
