from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class DepthSensor(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_SENSOR_UNSPECIFIED: _ClassVar[DepthSensor]
    DEPTH_SENSOR_TIME_OF_FLIGHT: _ClassVar[DepthSensor]
    DEPTH_SENSOR_STRUCTURED_LIGHT: _ClassVar[DepthSensor]
    DEPTH_SENSOR_STEREO: _ClassVar[DepthSensor]
    DEPTH_SENSOR_PHONE_LIDAR: _ClassVar[DepthSensor]
    DEPTH_SENSOR_RENDERED: _ClassVar[DepthSensor]
DEPTH_SENSOR_UNSPECIFIED: DepthSensor
DEPTH_SENSOR_TIME_OF_FLIGHT: DepthSensor
DEPTH_SENSOR_STRUCTURED_LIGHT: DepthSensor
DEPTH_SENSOR_STEREO: DepthSensor
DEPTH_SENSOR_PHONE_LIDAR: DepthSensor
DEPTH_SENSOR_RENDERED: DepthSensor

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("x", "y", "z", "w")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    W_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    w: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., w: _Optional[float] = ...) -> None: ...

class RigidTransform(_message.Message):
    __slots__ = ("rotation", "translation_m")
    ROTATION_FIELD_NUMBER: _ClassVar[int]
    TRANSLATION_M_FIELD_NUMBER: _ClassVar[int]
    rotation: Quaternion
    translation_m: Vector3
    def __init__(self, rotation: _Optional[_Union[Quaternion, _Mapping]] = ..., translation_m: _Optional[_Union[Vector3, _Mapping]] = ...) -> None: ...

class RadialTangentialDistortion(_message.Message):
    __slots__ = ("k1", "k2", "p1", "p2", "k3")
    K1_FIELD_NUMBER: _ClassVar[int]
    K2_FIELD_NUMBER: _ClassVar[int]
    P1_FIELD_NUMBER: _ClassVar[int]
    P2_FIELD_NUMBER: _ClassVar[int]
    K3_FIELD_NUMBER: _ClassVar[int]
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    def __init__(self, k1: _Optional[float] = ..., k2: _Optional[float] = ..., p1: _Optional[float] = ..., p2: _Optional[float] = ..., k3: _Optional[float] = ...) -> None: ...

class FisheyeDistortion(_message.Message):
    __slots__ = ("k1", "k2", "k3", "k4")
    K1_FIELD_NUMBER: _ClassVar[int]
    K2_FIELD_NUMBER: _ClassVar[int]
    K3_FIELD_NUMBER: _ClassVar[int]
    K4_FIELD_NUMBER: _ClassVar[int]
    k1: float
    k2: float
    k3: float
    k4: float
    def __init__(self, k1: _Optional[float] = ..., k2: _Optional[float] = ..., k3: _Optional[float] = ..., k4: _Optional[float] = ...) -> None: ...

class CameraIntrinsics(_message.Message):
    __slots__ = ("width_px", "height_px", "focal_x_px", "focal_y_px", "principal_x_px", "principal_y_px", "radial_tangential", "fisheye")
    WIDTH_PX_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_PX_FIELD_NUMBER: _ClassVar[int]
    FOCAL_X_PX_FIELD_NUMBER: _ClassVar[int]
    FOCAL_Y_PX_FIELD_NUMBER: _ClassVar[int]
    PRINCIPAL_X_PX_FIELD_NUMBER: _ClassVar[int]
    PRINCIPAL_Y_PX_FIELD_NUMBER: _ClassVar[int]
    RADIAL_TANGENTIAL_FIELD_NUMBER: _ClassVar[int]
    FISHEYE_FIELD_NUMBER: _ClassVar[int]
    width_px: int
    height_px: int
    focal_x_px: float
    focal_y_px: float
    principal_x_px: float
    principal_y_px: float
    radial_tangential: RadialTangentialDistortion
    fisheye: FisheyeDistortion
    def __init__(self, width_px: _Optional[int] = ..., height_px: _Optional[int] = ..., focal_x_px: _Optional[float] = ..., focal_y_px: _Optional[float] = ..., principal_x_px: _Optional[float] = ..., principal_y_px: _Optional[float] = ..., radial_tangential: _Optional[_Union[RadialTangentialDistortion, _Mapping]] = ..., fisheye: _Optional[_Union[FisheyeDistortion, _Mapping]] = ...) -> None: ...

class DepthImage(_message.Message):
    __slots__ = ("png", "float32", "unit_m", "width_px", "height_px", "intrinsics", "camera_from_depth_camera", "confidence", "min_confidence", "sensor", "noise")
    PNG_FIELD_NUMBER: _ClassVar[int]
    FLOAT32_FIELD_NUMBER: _ClassVar[int]
    UNIT_M_FIELD_NUMBER: _ClassVar[int]
    WIDTH_PX_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_PX_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FROM_DEPTH_CAMERA_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    MIN_CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    SENSOR_FIELD_NUMBER: _ClassVar[int]
    NOISE_FIELD_NUMBER: _ClassVar[int]
    png: bytes
    float32: bytes
    unit_m: float
    width_px: int
    height_px: int
    intrinsics: CameraIntrinsics
    camera_from_depth_camera: RigidTransform
    confidence: bytes
    min_confidence: int
    sensor: DepthSensor
    noise: DepthNoise
    def __init__(self, png: _Optional[bytes] = ..., float32: _Optional[bytes] = ..., unit_m: _Optional[float] = ..., width_px: _Optional[int] = ..., height_px: _Optional[int] = ..., intrinsics: _Optional[_Union[CameraIntrinsics, _Mapping]] = ..., camera_from_depth_camera: _Optional[_Union[RigidTransform, _Mapping]] = ..., confidence: _Optional[bytes] = ..., min_confidence: _Optional[int] = ..., sensor: _Optional[_Union[DepthSensor, str]] = ..., noise: _Optional[_Union[DepthNoise, _Mapping]] = ...) -> None: ...

class DepthNoise(_message.Message):
    __slots__ = ("constant_m", "linear", "quadratic_per_m", "common")
    CONSTANT_M_FIELD_NUMBER: _ClassVar[int]
    LINEAR_FIELD_NUMBER: _ClassVar[int]
    QUADRATIC_PER_M_FIELD_NUMBER: _ClassVar[int]
    COMMON_FIELD_NUMBER: _ClassVar[int]
    constant_m: float
    linear: float
    quadratic_per_m: float
    common: float
    def __init__(self, constant_m: _Optional[float] = ..., linear: _Optional[float] = ..., quadratic_per_m: _Optional[float] = ..., common: _Optional[float] = ...) -> None: ...
