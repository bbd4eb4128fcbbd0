from google.protobuf import duration_pb2 as _duration_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from mapless.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Variant(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    VARIANT_UNSPECIFIED: _ClassVar[Variant]
    VARIANT_COARSE: _ClassVar[Variant]
    VARIANT_NO_STRUCTURE: _ClassVar[Variant]
    VARIANT_FULL: _ClassVar[Variant]
    VARIANT_BEST: _ClassVar[Variant]

class ScaleStrategy(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SCALE_STRATEGY_UNSPECIFIED: _ClassVar[ScaleStrategy]
    SCALE_STRATEGY_TRIANGULATION: _ClassVar[ScaleStrategy]
    SCALE_STRATEGY_TRAJECTORY: _ClassVar[ScaleStrategy]
    SCALE_STRATEGY_TWO_STAGE: _ClassVar[ScaleStrategy]

class PoseStage(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    POSE_STAGE_UNSPECIFIED: _ClassVar[PoseStage]
    POSE_STAGE_REFINED: _ClassVar[PoseStage]
    POSE_STAGE_INITIAL: _ClassVar[PoseStage]
    POSE_STAGE_COARSE: _ClassVar[PoseStage]

class RejectionReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REJECTION_REASON_UNSPECIFIED: _ClassVar[RejectionReason]
    REJECTION_REASON_NO_USABLE_REFERENCES: _ClassVar[RejectionReason]
    REJECTION_REASON_DEGENERATE_REFERENCES: _ClassVar[RejectionReason]
    REJECTION_REASON_LOW_TEXTURE: _ClassVar[RejectionReason]
    REJECTION_REASON_LOW_OVERLAP: _ClassVar[RejectionReason]
    REJECTION_REASON_SCALE_UNRELIABLE: _ClassVar[RejectionReason]
    REJECTION_REASON_TOO_FEW_MATCHES: _ClassVar[RejectionReason]
    REJECTION_REASON_PNP_FAILED: _ClassVar[RejectionReason]
    REJECTION_REASON_GATE: _ClassVar[RejectionReason]

class ScaleStage(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SCALE_STAGE_UNSPECIFIED: _ClassVar[ScaleStage]
    SCALE_STAGE_TRIANGULATION: _ClassVar[ScaleStage]
    SCALE_STAGE_TRAJECTORY: _ClassVar[ScaleStage]
VARIANT_UNSPECIFIED: Variant
VARIANT_COARSE: Variant
VARIANT_NO_STRUCTURE: Variant
VARIANT_FULL: Variant
VARIANT_BEST: Variant
SCALE_STRATEGY_UNSPECIFIED: ScaleStrategy
SCALE_STRATEGY_TRIANGULATION: ScaleStrategy
SCALE_STRATEGY_TRAJECTORY: ScaleStrategy
SCALE_STRATEGY_TWO_STAGE: ScaleStrategy
POSE_STAGE_UNSPECIFIED: PoseStage
POSE_STAGE_REFINED: PoseStage
POSE_STAGE_INITIAL: PoseStage
POSE_STAGE_COARSE: PoseStage
REJECTION_REASON_UNSPECIFIED: RejectionReason
REJECTION_REASON_NO_USABLE_REFERENCES: RejectionReason
REJECTION_REASON_DEGENERATE_REFERENCES: RejectionReason
REJECTION_REASON_LOW_TEXTURE: RejectionReason
REJECTION_REASON_LOW_OVERLAP: RejectionReason
REJECTION_REASON_SCALE_UNRELIABLE: RejectionReason
REJECTION_REASON_TOO_FEW_MATCHES: RejectionReason
REJECTION_REASON_PNP_FAILED: RejectionReason
REJECTION_REASON_GATE: RejectionReason
SCALE_STAGE_UNSPECIFIED: ScaleStage
SCALE_STAGE_TRIANGULATION: ScaleStage
SCALE_STAGE_TRAJECTORY: ScaleStage

class LocalizeRequest(_message.Message):
    __slots__ = ("scene", "references", "image", "intrinsics", "position_prior", "options", "capture_time", "session_from_camera", "heading_prior")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    SESSION_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    HEADING_PRIOR_FIELD_NUMBER: _ClassVar[int]
    scene: str
    references: _containers.RepeatedScalarFieldContainer[str]
    image: bytes
    intrinsics: _geometry_pb2.CameraIntrinsics
    position_prior: PositionPrior
    options: LocalizeOptions
    capture_time: _timestamp_pb2.Timestamp
    session_from_camera: _geometry_pb2.RigidTransform
    heading_prior: HeadingPrior
    def __init__(self, scene: _Optional[str] = ..., references: _Optional[_Iterable[str]] = ..., image: _Optional[bytes] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., position_prior: _Optional[_Union[PositionPrior, _Mapping]] = ..., options: _Optional[_Union[LocalizeOptions, _Mapping]] = ..., capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., session_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., heading_prior: _Optional[_Union[HeadingPrior, _Mapping]] = ...) -> None: ...

class PositionPrior(_message.Message):
    __slots__ = ("position_m", "radius_m")
    POSITION_M_FIELD_NUMBER: _ClassVar[int]
    RADIUS_M_FIELD_NUMBER: _ClassVar[int]
    position_m: _geometry_pb2.Vector3
    radius_m: float
    def __init__(self, position_m: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., radius_m: _Optional[float] = ...) -> None: ...

class HeadingPrior(_message.Message):
    __slots__ = ("direction", "max_angle_deg")
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    MAX_ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    direction: _geometry_pb2.Vector3
    max_angle_deg: float
    def __init__(self, direction: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., max_angle_deg: _Optional[float] = ...) -> None: ...

class LocalizeOptions(_message.Message):
    __slots__ = ("variant", "scale_strategy", "reference_count", "allow_coarse", "rerank_references")
    VARIANT_FIELD_NUMBER: _ClassVar[int]
    SCALE_STRATEGY_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    ALLOW_COARSE_FIELD_NUMBER: _ClassVar[int]
    RERANK_REFERENCES_FIELD_NUMBER: _ClassVar[int]
    variant: Variant
    scale_strategy: ScaleStrategy
    reference_count: int
    allow_coarse: bool
    rerank_references: bool
    def __init__(self, variant: _Optional[_Union[Variant, str]] = ..., scale_strategy: _Optional[_Union[ScaleStrategy, str]] = ..., reference_count: _Optional[int] = ..., allow_coarse: bool = ..., rerank_references: bool = ...) -> None: ...

class LocalizeResponse(_message.Message):
    __slots__ = ("localization", "rejection", "diagnostics", "capture_time", "session_from_camera")
    LOCALIZATION_FIELD_NUMBER: _ClassVar[int]
    REJECTION_FIELD_NUMBER: _ClassVar[int]
    DIAGNOSTICS_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    SESSION_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    localization: Localization
    rejection: Rejection
    diagnostics: Diagnostics
    capture_time: _timestamp_pb2.Timestamp
    session_from_camera: _geometry_pb2.RigidTransform
    def __init__(self, localization: _Optional[_Union[Localization, _Mapping]] = ..., rejection: _Optional[_Union[Rejection, _Mapping]] = ..., diagnostics: _Optional[_Union[Diagnostics, _Mapping]] = ..., capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., session_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ...) -> None: ...

class Localization(_message.Message):
    __slots__ = ("world_from_camera", "covariance", "accuracy", "pose_stage", "inlier_count", "match_count", "reprojection_error_px")
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    ACCURACY_FIELD_NUMBER: _ClassVar[int]
    POSE_STAGE_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    REPROJECTION_ERROR_PX_FIELD_NUMBER: _ClassVar[int]
    world_from_camera: _geometry_pb2.RigidTransform
    covariance: PoseCovariance
    accuracy: Accuracy
    pose_stage: PoseStage
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    def __init__(self, world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., covariance: _Optional[_Union[PoseCovariance, _Mapping]] = ..., accuracy: _Optional[_Union[Accuracy, _Mapping]] = ..., pose_stage: _Optional[_Union[PoseStage, str]] = ..., inlier_count: _Optional[int] = ..., match_count: _Optional[int] = ..., reprojection_error_px: _Optional[float] = ...) -> None: ...

class PoseCovariance(_message.Message):
    __slots__ = ("row_major",)
    ROW_MAJOR_FIELD_NUMBER: _ClassVar[int]
    row_major: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, row_major: _Optional[_Iterable[float]] = ...) -> None: ...

class Accuracy(_message.Message):
    __slots__ = ("position_68_m", "position_95_m", "rotation_68_deg", "rotation_95_deg", "calibrated")
    POSITION_68_M_FIELD_NUMBER: _ClassVar[int]
    POSITION_95_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_68_DEG_FIELD_NUMBER: _ClassVar[int]
    ROTATION_95_DEG_FIELD_NUMBER: _ClassVar[int]
    CALIBRATED_FIELD_NUMBER: _ClassVar[int]
    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float
    calibrated: bool
    def __init__(self, position_68_m: _Optional[float] = ..., position_95_m: _Optional[float] = ..., rotation_68_deg: _Optional[float] = ..., rotation_95_deg: _Optional[float] = ..., calibrated: bool = ...) -> None: ...

class Rejection(_message.Message):
    __slots__ = ("reason", "message")
    REASON_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    reason: RejectionReason
    message: str
    def __init__(self, reason: _Optional[_Union[RejectionReason, str]] = ..., message: _Optional[str] = ...) -> None: ...

class Diagnostics(_message.Message):
    __slots__ = ("request_id", "backend", "weights_sha256", "features", "variant", "store_generation", "references", "scale", "stages", "queue_duration", "total_duration", "processed_width_px", "processed_height_px", "server_version", "retrieval")
    REQUEST_ID_FIELD_NUMBER: _ClassVar[int]
    BACKEND_FIELD_NUMBER: _ClassVar[int]
    WEIGHTS_SHA256_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    VARIANT_FIELD_NUMBER: _ClassVar[int]
    STORE_GENERATION_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    STAGES_FIELD_NUMBER: _ClassVar[int]
    QUEUE_DURATION_FIELD_NUMBER: _ClassVar[int]
    TOTAL_DURATION_FIELD_NUMBER: _ClassVar[int]
    PROCESSED_WIDTH_PX_FIELD_NUMBER: _ClassVar[int]
    PROCESSED_HEIGHT_PX_FIELD_NUMBER: _ClassVar[int]
    SERVER_VERSION_FIELD_NUMBER: _ClassVar[int]
    RETRIEVAL_FIELD_NUMBER: _ClassVar[int]
    request_id: str
    backend: str
    weights_sha256: str
    features: str
    variant: Variant
    store_generation: int
    references: _containers.RepeatedCompositeFieldContainer[ReferenceUse]
    scale: ScaleEstimate
    stages: _containers.RepeatedCompositeFieldContainer[StageTiming]
    queue_duration: _duration_pb2.Duration
    total_duration: _duration_pb2.Duration
    processed_width_px: int
    processed_height_px: int
    server_version: str
    retrieval: str
    def __init__(self, request_id: _Optional[str] = ..., backend: _Optional[str] = ..., weights_sha256: _Optional[str] = ..., features: _Optional[str] = ..., variant: _Optional[_Union[Variant, str]] = ..., store_generation: _Optional[int] = ..., references: _Optional[_Iterable[_Union[ReferenceUse, _Mapping]]] = ..., scale: _Optional[_Union[ScaleEstimate, _Mapping]] = ..., stages: _Optional[_Iterable[_Union[StageTiming, _Mapping]]] = ..., queue_duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ..., total_duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ..., processed_width_px: _Optional[int] = ..., processed_height_px: _Optional[int] = ..., server_version: _Optional[str] = ..., retrieval: _Optional[str] = ...) -> None: ...

class ReferenceUse(_message.Message):
    __slots__ = ("name", "match_count", "inlier_count", "similarity")
    NAME_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    SIMILARITY_FIELD_NUMBER: _ClassVar[int]
    name: str
    match_count: int
    inlier_count: int
    similarity: float
    def __init__(self, name: _Optional[str] = ..., match_count: _Optional[int] = ..., inlier_count: _Optional[int] = ..., similarity: _Optional[float] = ...) -> None: ...

class ScaleEstimate(_message.Message):
    __slots__ = ("metres_per_unit", "stage", "deviation")
    METRES_PER_UNIT_FIELD_NUMBER: _ClassVar[int]
    STAGE_FIELD_NUMBER: _ClassVar[int]
    DEVIATION_FIELD_NUMBER: _ClassVar[int]
    metres_per_unit: float
    stage: ScaleStage
    deviation: float
    def __init__(self, metres_per_unit: _Optional[float] = ..., stage: _Optional[_Union[ScaleStage, str]] = ..., deviation: _Optional[float] = ...) -> None: ...

class StageTiming(_message.Message):
    __slots__ = ("stage", "duration")
    STAGE_FIELD_NUMBER: _ClassVar[int]
    DURATION_FIELD_NUMBER: _ClassVar[int]
    stage: str
    duration: _duration_pb2.Duration
    def __init__(self, stage: _Optional[str] = ..., duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ...) -> None: ...
