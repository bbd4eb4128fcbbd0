from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

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
