from google.protobuf import duration_pb2 as _duration_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from mapless.v1 import geometry_pb2 as _geometry_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ReadoutDirection(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    READOUT_DIRECTION_UNSPECIFIED: _ClassVar[ReadoutDirection]
    READOUT_DIRECTION_TOP_TO_BOTTOM: _ClassVar[ReadoutDirection]
    READOUT_DIRECTION_BOTTOM_TO_TOP: _ClassVar[ReadoutDirection]
    READOUT_DIRECTION_LEFT_TO_RIGHT: _ClassVar[ReadoutDirection]
    READOUT_DIRECTION_RIGHT_TO_LEFT: _ClassVar[ReadoutDirection]

class Axes(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    AXES_UNSPECIFIED: _ClassVar[Axes]
    AXES_OPENCV: _ClassVar[Axes]
    AXES_ARKIT: _ClassVar[Axes]
    AXES_ARCORE: _ClassVar[Axes]
    AXES_UNITY: _ClassVar[Axes]
    AXES_ROS: _ClassVar[Axes]

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

class IntrinsicsSource(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    INTRINSICS_SOURCE_UNSPECIFIED: _ClassVar[IntrinsicsSource]
    INTRINSICS_SOURCE_GIVEN: _ClassVar[IntrinsicsSource]
    INTRINSICS_SOURCE_SCENE_CAMERA: _ClassVar[IntrinsicsSource]
    INTRINSICS_SOURCE_EXIF: _ClassVar[IntrinsicsSource]
    INTRINSICS_SOURCE_ESTIMATED: _ClassVar[IntrinsicsSource]

class ScaleSource(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SCALE_SOURCE_UNSPECIFIED: _ClassVar[ScaleSource]
    SCALE_SOURCE_REFERENCES: _ClassVar[ScaleSource]
    SCALE_SOURCE_NETWORK: _ClassVar[ScaleSource]
    SCALE_SOURCE_DEPTH: _ClassVar[ScaleSource]

class IntrinsicsParameter(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    INTRINSICS_PARAMETER_UNSPECIFIED: _ClassVar[IntrinsicsParameter]
    INTRINSICS_PARAMETER_FOCAL_LENGTH: _ClassVar[IntrinsicsParameter]
    INTRINSICS_PARAMETER_PRINCIPAL_X: _ClassVar[IntrinsicsParameter]
    INTRINSICS_PARAMETER_PRINCIPAL_Y: _ClassVar[IntrinsicsParameter]
    INTRINSICS_PARAMETER_K1: _ClassVar[IntrinsicsParameter]

class PriorKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PRIOR_KIND_UNSPECIFIED: _ClassVar[PriorKind]
    PRIOR_KIND_POSITION: _ClassVar[PriorKind]
    PRIOR_KIND_HEADING: _ClassVar[PriorKind]
    PRIOR_KIND_GRAVITY: _ClassVar[PriorKind]
    PRIOR_KIND_POSE: _ClassVar[PriorKind]

class PoseStage(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    POSE_STAGE_UNSPECIFIED: _ClassVar[PoseStage]
    POSE_STAGE_REFINED: _ClassVar[PoseStage]
    POSE_STAGE_INITIAL: _ClassVar[PoseStage]
    POSE_STAGE_COARSE: _ClassVar[PoseStage]

class CalibrationSource(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CALIBRATION_SOURCE_UNSPECIFIED: _ClassVar[CalibrationSource]
    CALIBRATION_SOURCE_GENERIC: _ClassVar[CalibrationSource]
    CALIBRATION_SOURCE_SELF: _ClassVar[CalibrationSource]
    CALIBRATION_SOURCE_MEASURED: _ClassVar[CalibrationSource]

class Advice(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ADVICE_UNSPECIFIED: _ClassVar[Advice]
    ADVICE_ADD_REFERENCES: _ClassVar[Advice]
    ADVICE_SPREAD_REFERENCES: _ClassVar[Advice]
    ADVICE_RETAKE_PHOTOGRAPH: _ClassVar[Advice]
    ADVICE_LOOK_AT_REFERENCE: _ClassVar[Advice]
    ADVICE_CHOOSE_OTHER_REFERENCES: _ClassVar[Advice]
    ADVICE_CHECK_CALIBRATION: _ClassVar[Advice]
    ADVICE_TELL_PLACES_APART: _ClassVar[Advice]
    ADVICE_CHECK_PRIOR: _ClassVar[Advice]
    ADVICE_CHECK_REFERENCE_POSES: _ClassVar[Advice]

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
    REJECTION_REASON_AMBIGUOUS: _ClassVar[RejectionReason]
    REJECTION_REASON_PRIOR_CONFLICT: _ClassVar[RejectionReason]

class AdoptionOffer(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ADOPTION_OFFER_UNSPECIFIED: _ClassVar[AdoptionOffer]
    ADOPTION_OFFER_WAITING: _ClassVar[AdoptionOffer]
    ADOPTION_OFFER_SCENE_ADOPTS_NOTHING: _ClassVar[AdoptionOffer]
    ADOPTION_OFFER_CONFIDENTIAL: _ClassVar[AdoptionOffer]
    ADOPTION_OFFER_REFERENCES_NAMED: _ClassVar[AdoptionOffer]
    ADOPTION_OFFER_NOT_LOCALIZED: _ClassVar[AdoptionOffer]
    ADOPTION_OFFER_UNCERTAIN: _ClassVar[AdoptionOffer]
    ADOPTION_OFFER_QUEUE_FULL: _ClassVar[AdoptionOffer]

class LadderCutReason(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LADDER_CUT_REASON_UNSPECIFIED: _ClassVar[LadderCutReason]
    LADDER_CUT_REASON_NO_TIME: _ClassVar[LadderCutReason]
    LADDER_CUT_REASON_CALLER_FAILS: _ClassVar[LadderCutReason]
    LADDER_CUT_REASON_FEATURES_MISSING: _ClassVar[LadderCutReason]
    LADDER_CUT_REASON_OUT_OF_MEMORY: _ClassVar[LadderCutReason]
    LADDER_CUT_REASON_FAILED: _ClassVar[LadderCutReason]

class ScaleStage(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    SCALE_STAGE_UNSPECIFIED: _ClassVar[ScaleStage]
    SCALE_STAGE_TRIANGULATION: _ClassVar[ScaleStage]
    SCALE_STAGE_TRAJECTORY: _ClassVar[ScaleStage]
    SCALE_STAGE_NETWORK: _ClassVar[ScaleStage]
    SCALE_STAGE_DEPTH: _ClassVar[ScaleStage]

class PointSource(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    POINT_SOURCE_UNSPECIFIED: _ClassVar[PointSource]
    POINT_SOURCE_TRIANGULATED: _ClassVar[PointSource]
    POINT_SOURCE_MEASURED_DEPTH: _ClassVar[PointSource]
    POINT_SOURCE_KEPT_DEPTH: _ClassVar[PointSource]
    POINT_SOURCE_NETWORK_DEPTH: _ClassVar[PointSource]
    POINT_SOURCE_PHOTOGRAPH_DEPTH: _ClassVar[PointSource]
READOUT_DIRECTION_UNSPECIFIED: ReadoutDirection
READOUT_DIRECTION_TOP_TO_BOTTOM: ReadoutDirection
READOUT_DIRECTION_BOTTOM_TO_TOP: ReadoutDirection
READOUT_DIRECTION_LEFT_TO_RIGHT: ReadoutDirection
READOUT_DIRECTION_RIGHT_TO_LEFT: ReadoutDirection
AXES_UNSPECIFIED: Axes
AXES_OPENCV: Axes
AXES_ARKIT: Axes
AXES_ARCORE: Axes
AXES_UNITY: Axes
AXES_ROS: Axes
VARIANT_UNSPECIFIED: Variant
VARIANT_COARSE: Variant
VARIANT_NO_STRUCTURE: Variant
VARIANT_FULL: Variant
VARIANT_BEST: Variant
SCALE_STRATEGY_UNSPECIFIED: ScaleStrategy
SCALE_STRATEGY_TRIANGULATION: ScaleStrategy
SCALE_STRATEGY_TRAJECTORY: ScaleStrategy
SCALE_STRATEGY_TWO_STAGE: ScaleStrategy
INTRINSICS_SOURCE_UNSPECIFIED: IntrinsicsSource
INTRINSICS_SOURCE_GIVEN: IntrinsicsSource
INTRINSICS_SOURCE_SCENE_CAMERA: IntrinsicsSource
INTRINSICS_SOURCE_EXIF: IntrinsicsSource
INTRINSICS_SOURCE_ESTIMATED: IntrinsicsSource
SCALE_SOURCE_UNSPECIFIED: ScaleSource
SCALE_SOURCE_REFERENCES: ScaleSource
SCALE_SOURCE_NETWORK: ScaleSource
SCALE_SOURCE_DEPTH: ScaleSource
INTRINSICS_PARAMETER_UNSPECIFIED: IntrinsicsParameter
INTRINSICS_PARAMETER_FOCAL_LENGTH: IntrinsicsParameter
INTRINSICS_PARAMETER_PRINCIPAL_X: IntrinsicsParameter
INTRINSICS_PARAMETER_PRINCIPAL_Y: IntrinsicsParameter
INTRINSICS_PARAMETER_K1: IntrinsicsParameter
PRIOR_KIND_UNSPECIFIED: PriorKind
PRIOR_KIND_POSITION: PriorKind
PRIOR_KIND_HEADING: PriorKind
PRIOR_KIND_GRAVITY: PriorKind
PRIOR_KIND_POSE: PriorKind
POSE_STAGE_UNSPECIFIED: PoseStage
POSE_STAGE_REFINED: PoseStage
POSE_STAGE_INITIAL: PoseStage
POSE_STAGE_COARSE: PoseStage
CALIBRATION_SOURCE_UNSPECIFIED: CalibrationSource
CALIBRATION_SOURCE_GENERIC: CalibrationSource
CALIBRATION_SOURCE_SELF: CalibrationSource
CALIBRATION_SOURCE_MEASURED: CalibrationSource
ADVICE_UNSPECIFIED: Advice
ADVICE_ADD_REFERENCES: Advice
ADVICE_SPREAD_REFERENCES: Advice
ADVICE_RETAKE_PHOTOGRAPH: Advice
ADVICE_LOOK_AT_REFERENCE: Advice
ADVICE_CHOOSE_OTHER_REFERENCES: Advice
ADVICE_CHECK_CALIBRATION: Advice
ADVICE_TELL_PLACES_APART: Advice
ADVICE_CHECK_PRIOR: Advice
ADVICE_CHECK_REFERENCE_POSES: Advice
REJECTION_REASON_UNSPECIFIED: RejectionReason
REJECTION_REASON_NO_USABLE_REFERENCES: RejectionReason
REJECTION_REASON_DEGENERATE_REFERENCES: RejectionReason
REJECTION_REASON_LOW_TEXTURE: RejectionReason
REJECTION_REASON_LOW_OVERLAP: RejectionReason
REJECTION_REASON_SCALE_UNRELIABLE: RejectionReason
REJECTION_REASON_TOO_FEW_MATCHES: RejectionReason
REJECTION_REASON_PNP_FAILED: RejectionReason
REJECTION_REASON_GATE: RejectionReason
REJECTION_REASON_AMBIGUOUS: RejectionReason
REJECTION_REASON_PRIOR_CONFLICT: RejectionReason
ADOPTION_OFFER_UNSPECIFIED: AdoptionOffer
ADOPTION_OFFER_WAITING: AdoptionOffer
ADOPTION_OFFER_SCENE_ADOPTS_NOTHING: AdoptionOffer
ADOPTION_OFFER_CONFIDENTIAL: AdoptionOffer
ADOPTION_OFFER_REFERENCES_NAMED: AdoptionOffer
ADOPTION_OFFER_NOT_LOCALIZED: AdoptionOffer
ADOPTION_OFFER_UNCERTAIN: AdoptionOffer
ADOPTION_OFFER_QUEUE_FULL: AdoptionOffer
LADDER_CUT_REASON_UNSPECIFIED: LadderCutReason
LADDER_CUT_REASON_NO_TIME: LadderCutReason
LADDER_CUT_REASON_CALLER_FAILS: LadderCutReason
LADDER_CUT_REASON_FEATURES_MISSING: LadderCutReason
LADDER_CUT_REASON_OUT_OF_MEMORY: LadderCutReason
LADDER_CUT_REASON_FAILED: LadderCutReason
SCALE_STAGE_UNSPECIFIED: ScaleStage
SCALE_STAGE_TRIANGULATION: ScaleStage
SCALE_STAGE_TRAJECTORY: ScaleStage
SCALE_STAGE_NETWORK: ScaleStage
SCALE_STAGE_DEPTH: ScaleStage
POINT_SOURCE_UNSPECIFIED: PointSource
POINT_SOURCE_TRIANGULATED: PointSource
POINT_SOURCE_MEASURED_DEPTH: PointSource
POINT_SOURCE_KEPT_DEPTH: PointSource
POINT_SOURCE_NETWORK_DEPTH: PointSource
POINT_SOURCE_PHOTOGRAPH_DEPTH: PointSource

class LocalizeRequest(_message.Message):
    __slots__ = ("scene", "references", "image", "intrinsics", "position_prior", "options", "capture_time", "session_from_camera", "heading_prior", "geo_position_prior", "gravity_prior", "pose_prior", "intrinsics_uncertainty", "mask", "depth", "scenes", "scene_group", "prior_scene")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    SESSION_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    HEADING_PRIOR_FIELD_NUMBER: _ClassVar[int]
    GEO_POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_PRIOR_FIELD_NUMBER: _ClassVar[int]
    POSE_PRIOR_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_UNCERTAINTY_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    SCENES_FIELD_NUMBER: _ClassVar[int]
    SCENE_GROUP_FIELD_NUMBER: _ClassVar[int]
    PRIOR_SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    references: _containers.RepeatedScalarFieldContainer[str]
    image: bytes
    intrinsics: _geometry_pb2.CameraIntrinsics
    position_prior: PositionPrior
    options: LocalizeOptions
    capture_time: _timestamp_pb2.Timestamp
    session_from_camera: _geometry_pb2.RigidTransform
    heading_prior: HeadingPrior
    geo_position_prior: GeoPositionPrior
    gravity_prior: GravityPrior
    pose_prior: PosePrior
    intrinsics_uncertainty: IntrinsicsUncertainty
    mask: bytes
    depth: _geometry_pb2.DepthImage
    scenes: _containers.RepeatedScalarFieldContainer[str]
    scene_group: SceneGroup
    prior_scene: str
    def __init__(self, scene: _Optional[str] = ..., references: _Optional[_Iterable[str]] = ..., image: _Optional[bytes] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., position_prior: _Optional[_Union[PositionPrior, _Mapping]] = ..., options: _Optional[_Union[LocalizeOptions, _Mapping]] = ..., capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., session_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., heading_prior: _Optional[_Union[HeadingPrior, _Mapping]] = ..., geo_position_prior: _Optional[_Union[GeoPositionPrior, _Mapping]] = ..., gravity_prior: _Optional[_Union[GravityPrior, _Mapping]] = ..., pose_prior: _Optional[_Union[PosePrior, _Mapping]] = ..., intrinsics_uncertainty: _Optional[_Union[IntrinsicsUncertainty, _Mapping]] = ..., mask: _Optional[bytes] = ..., depth: _Optional[_Union[_geometry_pb2.DepthImage, _Mapping]] = ..., scenes: _Optional[_Iterable[str]] = ..., scene_group: _Optional[_Union[SceneGroup, _Mapping]] = ..., prior_scene: _Optional[str] = ...) -> None: ...

class SceneGroup(_message.Message):
    __slots__ = ("labels", "with_datum")
    class LabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    LABELS_FIELD_NUMBER: _ClassVar[int]
    WITH_DATUM_FIELD_NUMBER: _ClassVar[int]
    labels: _containers.ScalarMap[str, str]
    with_datum: bool
    def __init__(self, labels: _Optional[_Mapping[str, str]] = ..., with_datum: bool = ...) -> None: ...

class IntrinsicsUncertainty(_message.Message):
    __slots__ = ("focal_sigma_px", "principal_sigma_px", "k1_sigma", "readout_s", "readout_direction", "speed_m_per_s", "turn_deg_per_s")
    FOCAL_SIGMA_PX_FIELD_NUMBER: _ClassVar[int]
    PRINCIPAL_SIGMA_PX_FIELD_NUMBER: _ClassVar[int]
    K1_SIGMA_FIELD_NUMBER: _ClassVar[int]
    READOUT_S_FIELD_NUMBER: _ClassVar[int]
    READOUT_DIRECTION_FIELD_NUMBER: _ClassVar[int]
    SPEED_M_PER_S_FIELD_NUMBER: _ClassVar[int]
    TURN_DEG_PER_S_FIELD_NUMBER: _ClassVar[int]
    focal_sigma_px: float
    principal_sigma_px: float
    k1_sigma: float
    readout_s: float
    readout_direction: ReadoutDirection
    speed_m_per_s: float
    turn_deg_per_s: float
    def __init__(self, focal_sigma_px: _Optional[float] = ..., principal_sigma_px: _Optional[float] = ..., k1_sigma: _Optional[float] = ..., readout_s: _Optional[float] = ..., readout_direction: _Optional[_Union[ReadoutDirection, str]] = ..., speed_m_per_s: _Optional[float] = ..., turn_deg_per_s: _Optional[float] = ...) -> None: ...

class PositionPrior(_message.Message):
    __slots__ = ("position_m", "radius_m", "covariance_m2")
    POSITION_M_FIELD_NUMBER: _ClassVar[int]
    RADIUS_M_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_M2_FIELD_NUMBER: _ClassVar[int]
    position_m: _geometry_pb2.Vector3
    radius_m: float
    covariance_m2: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, position_m: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., radius_m: _Optional[float] = ..., covariance_m2: _Optional[_Iterable[float]] = ...) -> None: ...

class GeoPositionPrior(_message.Message):
    __slots__ = ("latitude_deg", "longitude_deg", "height_m", "horizontal_sigma_m", "vertical_sigma_m")
    LATITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_M_FIELD_NUMBER: _ClassVar[int]
    HORIZONTAL_SIGMA_M_FIELD_NUMBER: _ClassVar[int]
    VERTICAL_SIGMA_M_FIELD_NUMBER: _ClassVar[int]
    latitude_deg: float
    longitude_deg: float
    height_m: float
    horizontal_sigma_m: float
    vertical_sigma_m: float
    def __init__(self, latitude_deg: _Optional[float] = ..., longitude_deg: _Optional[float] = ..., height_m: _Optional[float] = ..., horizontal_sigma_m: _Optional[float] = ..., vertical_sigma_m: _Optional[float] = ...) -> None: ...

class HeadingPrior(_message.Message):
    __slots__ = ("direction", "max_angle_deg", "sigma_deg")
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    MAX_ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    SIGMA_DEG_FIELD_NUMBER: _ClassVar[int]
    direction: _geometry_pb2.Vector3
    max_angle_deg: float
    sigma_deg: float
    def __init__(self, direction: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., max_angle_deg: _Optional[float] = ..., sigma_deg: _Optional[float] = ...) -> None: ...

class GravityPrior(_message.Message):
    __slots__ = ("down_in_camera", "sigma_deg", "down_in_world")
    DOWN_IN_CAMERA_FIELD_NUMBER: _ClassVar[int]
    SIGMA_DEG_FIELD_NUMBER: _ClassVar[int]
    DOWN_IN_WORLD_FIELD_NUMBER: _ClassVar[int]
    down_in_camera: _geometry_pb2.Vector3
    sigma_deg: float
    down_in_world: _geometry_pb2.Vector3
    def __init__(self, down_in_camera: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., sigma_deg: _Optional[float] = ..., down_in_world: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ...) -> None: ...

class PosePrior(_message.Message):
    __slots__ = ("world_from_camera", "covariance")
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    world_from_camera: _geometry_pb2.RigidTransform
    covariance: PoseCovariance
    def __init__(self, world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., covariance: _Optional[_Union[PoseCovariance, _Mapping]] = ...) -> None: ...

class LocalizeOptions(_message.Message):
    __slots__ = ("variant", "scale_strategy", "reference_count", "allow_coarse", "rerank_references", "axes", "include_debug", "coverage", "ignore_calibration", "confidential", "include_imprecise_pose", "allow_adoption")
    VARIANT_FIELD_NUMBER: _ClassVar[int]
    SCALE_STRATEGY_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    ALLOW_COARSE_FIELD_NUMBER: _ClassVar[int]
    RERANK_REFERENCES_FIELD_NUMBER: _ClassVar[int]
    AXES_FIELD_NUMBER: _ClassVar[int]
    INCLUDE_DEBUG_FIELD_NUMBER: _ClassVar[int]
    COVERAGE_FIELD_NUMBER: _ClassVar[int]
    IGNORE_CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    CONFIDENTIAL_FIELD_NUMBER: _ClassVar[int]
    INCLUDE_IMPRECISE_POSE_FIELD_NUMBER: _ClassVar[int]
    ALLOW_ADOPTION_FIELD_NUMBER: _ClassVar[int]
    variant: Variant
    scale_strategy: ScaleStrategy
    reference_count: int
    allow_coarse: bool
    rerank_references: bool
    axes: Axes
    include_debug: bool
    coverage: float
    ignore_calibration: bool
    confidential: bool
    include_imprecise_pose: bool
    allow_adoption: bool
    def __init__(self, variant: _Optional[_Union[Variant, str]] = ..., scale_strategy: _Optional[_Union[ScaleStrategy, str]] = ..., reference_count: _Optional[int] = ..., allow_coarse: bool = ..., rerank_references: bool = ..., axes: _Optional[_Union[Axes, str]] = ..., include_debug: bool = ..., coverage: _Optional[float] = ..., ignore_calibration: bool = ..., confidential: bool = ..., include_imprecise_pose: bool = ..., allow_adoption: bool = ...) -> None: ...

class LocalizeResponse(_message.Message):
    __slots__ = ("localization", "rejection", "diagnostics", "capture_time", "session_from_camera", "debug", "scene")
    LOCALIZATION_FIELD_NUMBER: _ClassVar[int]
    REJECTION_FIELD_NUMBER: _ClassVar[int]
    DIAGNOSTICS_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    SESSION_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    DEBUG_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    localization: Localization
    rejection: Rejection
    diagnostics: Diagnostics
    capture_time: _timestamp_pb2.Timestamp
    session_from_camera: _geometry_pb2.RigidTransform
    debug: Debug
    scene: str
    def __init__(self, localization: _Optional[_Union[Localization, _Mapping]] = ..., rejection: _Optional[_Union[Rejection, _Mapping]] = ..., diagnostics: _Optional[_Union[Diagnostics, _Mapping]] = ..., capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., session_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., debug: _Optional[_Union[Debug, _Mapping]] = ..., scene: _Optional[str] = ...) -> None: ...

class LocalizeProgressivelyResponse(_message.Message):
    __slots__ = ("answer", "is_final")
    ANSWER_FIELD_NUMBER: _ClassVar[int]
    IS_FINAL_FIELD_NUMBER: _ClassVar[int]
    answer: LocalizeResponse
    is_final: bool
    def __init__(self, answer: _Optional[_Union[LocalizeResponse, _Mapping]] = ..., is_final: bool = ...) -> None: ...

class Localization(_message.Message):
    __slots__ = ("world_from_camera", "covariance", "accuracy", "pose_stage", "inlier_count", "match_count", "reprojection_error_px", "trust", "in_axes", "geo_pose", "prior_checks", "arbitrary_unit", "scale_source", "intrinsics_checks", "used_intrinsics")
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    ACCURACY_FIELD_NUMBER: _ClassVar[int]
    POSE_STAGE_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    REPROJECTION_ERROR_PX_FIELD_NUMBER: _ClassVar[int]
    TRUST_FIELD_NUMBER: _ClassVar[int]
    IN_AXES_FIELD_NUMBER: _ClassVar[int]
    GEO_POSE_FIELD_NUMBER: _ClassVar[int]
    PRIOR_CHECKS_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    SCALE_SOURCE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_CHECKS_FIELD_NUMBER: _ClassVar[int]
    USED_INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    world_from_camera: _geometry_pb2.RigidTransform
    covariance: PoseCovariance
    accuracy: Accuracy
    pose_stage: PoseStage
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    trust: float
    in_axes: FramedPose
    geo_pose: GeoPose
    prior_checks: _containers.RepeatedCompositeFieldContainer[PriorCheck]
    arbitrary_unit: bool
    scale_source: ScaleSource
    intrinsics_checks: _containers.RepeatedCompositeFieldContainer[IntrinsicsCheck]
    used_intrinsics: UsedIntrinsics
    def __init__(self, world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., covariance: _Optional[_Union[PoseCovariance, _Mapping]] = ..., accuracy: _Optional[_Union[Accuracy, _Mapping]] = ..., pose_stage: _Optional[_Union[PoseStage, str]] = ..., inlier_count: _Optional[int] = ..., match_count: _Optional[int] = ..., reprojection_error_px: _Optional[float] = ..., trust: _Optional[float] = ..., in_axes: _Optional[_Union[FramedPose, _Mapping]] = ..., geo_pose: _Optional[_Union[GeoPose, _Mapping]] = ..., prior_checks: _Optional[_Iterable[_Union[PriorCheck, _Mapping]]] = ..., arbitrary_unit: bool = ..., scale_source: _Optional[_Union[ScaleSource, str]] = ..., intrinsics_checks: _Optional[_Iterable[_Union[IntrinsicsCheck, _Mapping]]] = ..., used_intrinsics: _Optional[_Union[UsedIntrinsics, _Mapping]] = ...) -> None: ...

class UsedIntrinsics(_message.Message):
    __slots__ = ("intrinsics", "source", "focal_sigma_px")
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    FOCAL_SIGMA_PX_FIELD_NUMBER: _ClassVar[int]
    intrinsics: _geometry_pb2.CameraIntrinsics
    source: IntrinsicsSource
    focal_sigma_px: float
    def __init__(self, intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., source: _Optional[_Union[IntrinsicsSource, str]] = ..., focal_sigma_px: _Optional[float] = ...) -> None: ...

class IntrinsicsCheck(_message.Message):
    __slots__ = ("parameter", "given", "estimated", "estimated_sigma", "given_sigma", "conflict", "used")
    PARAMETER_FIELD_NUMBER: _ClassVar[int]
    GIVEN_FIELD_NUMBER: _ClassVar[int]
    ESTIMATED_FIELD_NUMBER: _ClassVar[int]
    ESTIMATED_SIGMA_FIELD_NUMBER: _ClassVar[int]
    GIVEN_SIGMA_FIELD_NUMBER: _ClassVar[int]
    CONFLICT_FIELD_NUMBER: _ClassVar[int]
    USED_FIELD_NUMBER: _ClassVar[int]
    parameter: IntrinsicsParameter
    given: float
    estimated: float
    estimated_sigma: float
    given_sigma: float
    conflict: bool
    used: bool
    def __init__(self, parameter: _Optional[_Union[IntrinsicsParameter, str]] = ..., given: _Optional[float] = ..., estimated: _Optional[float] = ..., estimated_sigma: _Optional[float] = ..., given_sigma: _Optional[float] = ..., conflict: bool = ..., used: bool = ...) -> None: ...

class FramedPose(_message.Message):
    __slots__ = ("axes", "world_from_camera", "covariance", "world_from_session")
    AXES_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_SESSION_FIELD_NUMBER: _ClassVar[int]
    axes: Axes
    world_from_camera: _geometry_pb2.RigidTransform
    covariance: PoseCovariance
    world_from_session: _geometry_pb2.RigidTransform
    def __init__(self, axes: _Optional[_Union[Axes, str]] = ..., world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., covariance: _Optional[_Union[PoseCovariance, _Mapping]] = ..., world_from_session: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ...) -> None: ...

class GeoPose(_message.Message):
    __slots__ = ("position", "quaternion")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_FIELD_NUMBER: _ClassVar[int]
    position: GeoPosition
    quaternion: GeoQuaternion
    def __init__(self, position: _Optional[_Union[GeoPosition, _Mapping]] = ..., quaternion: _Optional[_Union[GeoQuaternion, _Mapping]] = ...) -> None: ...

class GeoPosition(_message.Message):
    __slots__ = ("lat", "lon", "h")
    LAT_FIELD_NUMBER: _ClassVar[int]
    LON_FIELD_NUMBER: _ClassVar[int]
    H_FIELD_NUMBER: _ClassVar[int]
    lat: float
    lon: float
    h: float
    def __init__(self, lat: _Optional[float] = ..., lon: _Optional[float] = ..., h: _Optional[float] = ...) -> None: ...

class GeoQuaternion(_message.Message):
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

class PriorCheck(_message.Message):
    __slots__ = ("kind", "mahalanobis", "degrees_of_freedom", "conflict", "used")
    KIND_FIELD_NUMBER: _ClassVar[int]
    MAHALANOBIS_FIELD_NUMBER: _ClassVar[int]
    DEGREES_OF_FREEDOM_FIELD_NUMBER: _ClassVar[int]
    CONFLICT_FIELD_NUMBER: _ClassVar[int]
    USED_FIELD_NUMBER: _ClassVar[int]
    kind: PriorKind
    mahalanobis: float
    degrees_of_freedom: int
    conflict: bool
    used: bool
    def __init__(self, kind: _Optional[_Union[PriorKind, str]] = ..., mahalanobis: _Optional[float] = ..., degrees_of_freedom: _Optional[int] = ..., conflict: bool = ..., used: bool = ...) -> None: ...

class PoseCovariance(_message.Message):
    __slots__ = ("row_major",)
    ROW_MAJOR_FIELD_NUMBER: _ClassVar[int]
    row_major: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, row_major: _Optional[_Iterable[float]] = ...) -> None: ...

class Accuracy(_message.Message):
    __slots__ = ("position_68_m", "position_95_m", "rotation_68_deg", "rotation_95_deg", "calibrated", "calibration", "sample_size")
    POSITION_68_M_FIELD_NUMBER: _ClassVar[int]
    POSITION_95_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_68_DEG_FIELD_NUMBER: _ClassVar[int]
    ROTATION_95_DEG_FIELD_NUMBER: _ClassVar[int]
    CALIBRATED_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    SAMPLE_SIZE_FIELD_NUMBER: _ClassVar[int]
    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float
    calibrated: bool
    calibration: CalibrationSource
    sample_size: int
    def __init__(self, position_68_m: _Optional[float] = ..., position_95_m: _Optional[float] = ..., rotation_68_deg: _Optional[float] = ..., rotation_95_deg: _Optional[float] = ..., calibrated: bool = ..., calibration: _Optional[_Union[CalibrationSource, str]] = ..., sample_size: _Optional[int] = ...) -> None: ...

class Rejection(_message.Message):
    __slots__ = ("reason", "message", "hint", "hypotheses", "intrinsics_checks", "used_intrinsics", "outdated_place")
    REASON_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    HINT_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_CHECKS_FIELD_NUMBER: _ClassVar[int]
    USED_INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    OUTDATED_PLACE_FIELD_NUMBER: _ClassVar[int]
    reason: RejectionReason
    message: str
    hint: Hint
    hypotheses: _containers.RepeatedCompositeFieldContainer[Hypothesis]
    intrinsics_checks: _containers.RepeatedCompositeFieldContainer[IntrinsicsCheck]
    used_intrinsics: UsedIntrinsics
    outdated_place: str
    def __init__(self, reason: _Optional[_Union[RejectionReason, str]] = ..., message: _Optional[str] = ..., hint: _Optional[_Union[Hint, _Mapping]] = ..., hypotheses: _Optional[_Iterable[_Union[Hypothesis, _Mapping]]] = ..., intrinsics_checks: _Optional[_Iterable[_Union[IntrinsicsCheck, _Mapping]]] = ..., used_intrinsics: _Optional[_Union[UsedIntrinsics, _Mapping]] = ..., outdated_place: _Optional[str] = ...) -> None: ...

class Hint(_message.Message):
    __slots__ = ("stage", "advice", "message", "best_reference")
    STAGE_FIELD_NUMBER: _ClassVar[int]
    ADVICE_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    BEST_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    stage: str
    advice: Advice
    message: str
    best_reference: str
    def __init__(self, stage: _Optional[str] = ..., advice: _Optional[_Union[Advice, str]] = ..., message: _Optional[str] = ..., best_reference: _Optional[str] = ...) -> None: ...

class Hypothesis(_message.Message):
    __slots__ = ("world_from_camera", "inlier_count", "references", "covariance", "accuracy", "arbitrary_unit", "in_axes", "geo_pose", "scene")
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    ACCURACY_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    IN_AXES_FIELD_NUMBER: _ClassVar[int]
    GEO_POSE_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    world_from_camera: _geometry_pb2.RigidTransform
    inlier_count: int
    references: _containers.RepeatedScalarFieldContainer[str]
    covariance: PoseCovariance
    accuracy: Accuracy
    arbitrary_unit: bool
    in_axes: FramedPose
    geo_pose: GeoPose
    scene: str
    def __init__(self, world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., inlier_count: _Optional[int] = ..., references: _Optional[_Iterable[str]] = ..., covariance: _Optional[_Union[PoseCovariance, _Mapping]] = ..., accuracy: _Optional[_Union[Accuracy, _Mapping]] = ..., arbitrary_unit: bool = ..., in_axes: _Optional[_Union[FramedPose, _Mapping]] = ..., geo_pose: _Optional[_Union[GeoPose, _Mapping]] = ..., scene: _Optional[str] = ...) -> None: ...

class Diagnostics(_message.Message):
    __slots__ = ("request_id", "backend", "weights_sha256", "features", "variant", "store_generation", "references", "scale", "stages", "queue_duration", "total_duration", "processed_width_px", "processed_height_px", "server_version", "retrieval", "captured", "processor_duration", "attempts", "stationary_keypoint_count", "ladder_cuts", "depth_check", "missing_evidence", "scenes", "searched_scene_count", "adoption")
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
    CAPTURED_FIELD_NUMBER: _ClassVar[int]
    PROCESSOR_DURATION_FIELD_NUMBER: _ClassVar[int]
    ATTEMPTS_FIELD_NUMBER: _ClassVar[int]
    STATIONARY_KEYPOINT_COUNT_FIELD_NUMBER: _ClassVar[int]
    LADDER_CUTS_FIELD_NUMBER: _ClassVar[int]
    DEPTH_CHECK_FIELD_NUMBER: _ClassVar[int]
    MISSING_EVIDENCE_FIELD_NUMBER: _ClassVar[int]
    SCENES_FIELD_NUMBER: _ClassVar[int]
    SEARCHED_SCENE_COUNT_FIELD_NUMBER: _ClassVar[int]
    ADOPTION_FIELD_NUMBER: _ClassVar[int]
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
    captured: bool
    processor_duration: _duration_pb2.Duration
    attempts: _containers.RepeatedCompositeFieldContainer[Attempt]
    stationary_keypoint_count: int
    ladder_cuts: _containers.RepeatedCompositeFieldContainer[LadderCut]
    depth_check: DepthCheck
    missing_evidence: _containers.RepeatedCompositeFieldContainer[MissingEvidence]
    scenes: _containers.RepeatedCompositeFieldContainer[SceneUse]
    searched_scene_count: int
    adoption: AdoptionOffer
    def __init__(self, request_id: _Optional[str] = ..., backend: _Optional[str] = ..., weights_sha256: _Optional[str] = ..., features: _Optional[str] = ..., variant: _Optional[_Union[Variant, str]] = ..., store_generation: _Optional[int] = ..., references: _Optional[_Iterable[_Union[ReferenceUse, _Mapping]]] = ..., scale: _Optional[_Union[ScaleEstimate, _Mapping]] = ..., stages: _Optional[_Iterable[_Union[StageTiming, _Mapping]]] = ..., queue_duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ..., total_duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ..., processed_width_px: _Optional[int] = ..., processed_height_px: _Optional[int] = ..., server_version: _Optional[str] = ..., retrieval: _Optional[str] = ..., captured: bool = ..., processor_duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ..., attempts: _Optional[_Iterable[_Union[Attempt, _Mapping]]] = ..., stationary_keypoint_count: _Optional[int] = ..., ladder_cuts: _Optional[_Iterable[_Union[LadderCut, _Mapping]]] = ..., depth_check: _Optional[_Union[DepthCheck, _Mapping]] = ..., missing_evidence: _Optional[_Iterable[_Union[MissingEvidence, _Mapping]]] = ..., scenes: _Optional[_Iterable[_Union[SceneUse, _Mapping]]] = ..., searched_scene_count: _Optional[int] = ..., adoption: _Optional[_Union[AdoptionOffer, str]] = ...) -> None: ...

class SceneUse(_message.Message):
    __slots__ = ("scene", "reference_count", "similarity", "match_count", "attempted", "agreement")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    SIMILARITY_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    ATTEMPTED_FIELD_NUMBER: _ClassVar[int]
    AGREEMENT_FIELD_NUMBER: _ClassVar[int]
    scene: str
    reference_count: int
    similarity: float
    match_count: int
    attempted: bool
    agreement: float
    def __init__(self, scene: _Optional[str] = ..., reference_count: _Optional[int] = ..., similarity: _Optional[float] = ..., match_count: _Optional[int] = ..., attempted: bool = ..., agreement: _Optional[float] = ...) -> None: ...

class MissingEvidence(_message.Message):
    __slots__ = ("kind", "name", "reference_count", "made_reference_count")
    KIND_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    MADE_REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    kind: str
    name: str
    reference_count: int
    made_reference_count: int
    def __init__(self, kind: _Optional[str] = ..., name: _Optional[str] = ..., reference_count: _Optional[int] = ..., made_reference_count: _Optional[int] = ...) -> None: ...

class DepthCheck(_message.Message):
    __slots__ = ("keypoint_count", "compared_count", "agreeing_count", "factor", "factor_sigma", "conflict", "used", "median", "point_count")
    KEYPOINT_COUNT_FIELD_NUMBER: _ClassVar[int]
    COMPARED_COUNT_FIELD_NUMBER: _ClassVar[int]
    AGREEING_COUNT_FIELD_NUMBER: _ClassVar[int]
    FACTOR_FIELD_NUMBER: _ClassVar[int]
    FACTOR_SIGMA_FIELD_NUMBER: _ClassVar[int]
    CONFLICT_FIELD_NUMBER: _ClassVar[int]
    USED_FIELD_NUMBER: _ClassVar[int]
    MEDIAN_FIELD_NUMBER: _ClassVar[int]
    POINT_COUNT_FIELD_NUMBER: _ClassVar[int]
    keypoint_count: int
    compared_count: int
    agreeing_count: int
    factor: float
    factor_sigma: float
    conflict: bool
    used: bool
    median: float
    point_count: int
    def __init__(self, keypoint_count: _Optional[int] = ..., compared_count: _Optional[int] = ..., agreeing_count: _Optional[int] = ..., factor: _Optional[float] = ..., factor_sigma: _Optional[float] = ..., conflict: bool = ..., used: bool = ..., median: _Optional[float] = ..., point_count: _Optional[int] = ...) -> None: ...

class LadderCut(_message.Message):
    __slots__ = ("rung", "features", "reason", "unmatched_reference_count")
    RUNG_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    UNMATCHED_REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    rung: str
    features: str
    reason: LadderCutReason
    unmatched_reference_count: int
    def __init__(self, rung: _Optional[str] = ..., features: _Optional[str] = ..., reason: _Optional[_Union[LadderCutReason, str]] = ..., unmatched_reference_count: _Optional[int] = ...) -> None: ...

class Attempt(_message.Message):
    __slots__ = ("rung", "features", "outcome", "duration", "processor_duration", "chosen")
    RUNG_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    DURATION_FIELD_NUMBER: _ClassVar[int]
    PROCESSOR_DURATION_FIELD_NUMBER: _ClassVar[int]
    CHOSEN_FIELD_NUMBER: _ClassVar[int]
    rung: str
    features: str
    outcome: str
    duration: _duration_pb2.Duration
    processor_duration: _duration_pb2.Duration
    chosen: bool
    def __init__(self, rung: _Optional[str] = ..., features: _Optional[str] = ..., outcome: _Optional[str] = ..., duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ..., processor_duration: _Optional[_Union[_duration_pb2.Duration, _Mapping]] = ..., chosen: bool = ...) -> None: ...

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

class Debug(_message.Message):
    __slots__ = ("query_x_px", "query_y_px", "point_x_m", "point_y_m", "point_z_m", "is_inlier", "error_px", "reference", "reference_x_px", "reference_y_px", "source")
    QUERY_X_PX_FIELD_NUMBER: _ClassVar[int]
    QUERY_Y_PX_FIELD_NUMBER: _ClassVar[int]
    POINT_X_M_FIELD_NUMBER: _ClassVar[int]
    POINT_Y_M_FIELD_NUMBER: _ClassVar[int]
    POINT_Z_M_FIELD_NUMBER: _ClassVar[int]
    IS_INLIER_FIELD_NUMBER: _ClassVar[int]
    ERROR_PX_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_X_PX_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_Y_PX_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    query_x_px: _containers.RepeatedScalarFieldContainer[float]
    query_y_px: _containers.RepeatedScalarFieldContainer[float]
    point_x_m: _containers.RepeatedScalarFieldContainer[float]
    point_y_m: _containers.RepeatedScalarFieldContainer[float]
    point_z_m: _containers.RepeatedScalarFieldContainer[float]
    is_inlier: _containers.RepeatedScalarFieldContainer[bool]
    error_px: _containers.RepeatedScalarFieldContainer[float]
    reference: _containers.RepeatedScalarFieldContainer[int]
    reference_x_px: _containers.RepeatedScalarFieldContainer[float]
    reference_y_px: _containers.RepeatedScalarFieldContainer[float]
    source: _containers.RepeatedScalarFieldContainer[PointSource]
    def __init__(self, query_x_px: _Optional[_Iterable[float]] = ..., query_y_px: _Optional[_Iterable[float]] = ..., point_x_m: _Optional[_Iterable[float]] = ..., point_y_m: _Optional[_Iterable[float]] = ..., point_z_m: _Optional[_Iterable[float]] = ..., is_inlier: _Optional[_Iterable[bool]] = ..., error_px: _Optional[_Iterable[float]] = ..., reference: _Optional[_Iterable[int]] = ..., reference_x_px: _Optional[_Iterable[float]] = ..., reference_y_px: _Optional[_Iterable[float]] = ..., source: _Optional[_Iterable[_Union[PointSource, str]]] = ...) -> None: ...

class LocalizeRigRequest(_message.Message):
    __slots__ = ("scene", "images", "options", "capture_time", "session_from_rig", "scenes", "scene_group", "prior_scene")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    SESSION_FROM_RIG_FIELD_NUMBER: _ClassVar[int]
    SCENES_FIELD_NUMBER: _ClassVar[int]
    SCENE_GROUP_FIELD_NUMBER: _ClassVar[int]
    PRIOR_SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    images: _containers.RepeatedCompositeFieldContainer[RigImage]
    options: LocalizeOptions
    capture_time: _timestamp_pb2.Timestamp
    session_from_rig: _geometry_pb2.RigidTransform
    scenes: _containers.RepeatedScalarFieldContainer[str]
    scene_group: SceneGroup
    prior_scene: str
    def __init__(self, scene: _Optional[str] = ..., images: _Optional[_Iterable[_Union[RigImage, _Mapping]]] = ..., options: _Optional[_Union[LocalizeOptions, _Mapping]] = ..., capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., session_from_rig: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., scenes: _Optional[_Iterable[str]] = ..., scene_group: _Optional[_Union[SceneGroup, _Mapping]] = ..., prior_scene: _Optional[str] = ...) -> None: ...

class RigImage(_message.Message):
    __slots__ = ("image", "intrinsics", "rig_from_camera", "references", "position_prior", "heading_prior", "geo_position_prior", "gravity_prior", "pose_prior", "mask", "depth", "intrinsics_uncertainty")
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    RIG_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    HEADING_PRIOR_FIELD_NUMBER: _ClassVar[int]
    GEO_POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_PRIOR_FIELD_NUMBER: _ClassVar[int]
    POSE_PRIOR_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_UNCERTAINTY_FIELD_NUMBER: _ClassVar[int]
    image: bytes
    intrinsics: _geometry_pb2.CameraIntrinsics
    rig_from_camera: _geometry_pb2.RigidTransform
    references: _containers.RepeatedScalarFieldContainer[str]
    position_prior: PositionPrior
    heading_prior: HeadingPrior
    geo_position_prior: GeoPositionPrior
    gravity_prior: GravityPrior
    pose_prior: PosePrior
    mask: bytes
    depth: _geometry_pb2.DepthImage
    intrinsics_uncertainty: IntrinsicsUncertainty
    def __init__(self, image: _Optional[bytes] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., rig_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., references: _Optional[_Iterable[str]] = ..., position_prior: _Optional[_Union[PositionPrior, _Mapping]] = ..., heading_prior: _Optional[_Union[HeadingPrior, _Mapping]] = ..., geo_position_prior: _Optional[_Union[GeoPositionPrior, _Mapping]] = ..., gravity_prior: _Optional[_Union[GravityPrior, _Mapping]] = ..., pose_prior: _Optional[_Union[PosePrior, _Mapping]] = ..., mask: _Optional[bytes] = ..., depth: _Optional[_Union[_geometry_pb2.DepthImage, _Mapping]] = ..., intrinsics_uncertainty: _Optional[_Union[IntrinsicsUncertainty, _Mapping]] = ...) -> None: ...

class LocalizeRigResponse(_message.Message):
    __slots__ = ("localization", "rejection", "images", "capture_time", "session_from_rig", "scene")
    LOCALIZATION_FIELD_NUMBER: _ClassVar[int]
    REJECTION_FIELD_NUMBER: _ClassVar[int]
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    SESSION_FROM_RIG_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    localization: RigLocalization
    rejection: Rejection
    images: _containers.RepeatedCompositeFieldContainer[ImageReport]
    capture_time: _timestamp_pb2.Timestamp
    session_from_rig: _geometry_pb2.RigidTransform
    scene: str
    def __init__(self, localization: _Optional[_Union[RigLocalization, _Mapping]] = ..., rejection: _Optional[_Union[Rejection, _Mapping]] = ..., images: _Optional[_Iterable[_Union[ImageReport, _Mapping]]] = ..., capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., session_from_rig: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., scene: _Optional[str] = ...) -> None: ...

class RigLocalization(_message.Message):
    __slots__ = ("world_from_rig", "covariance", "accuracy", "inlier_count", "match_count", "reprojection_error_px", "world_from_session", "geo_pose", "arbitrary_unit", "trust")
    WORLD_FROM_RIG_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    ACCURACY_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    REPROJECTION_ERROR_PX_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_SESSION_FIELD_NUMBER: _ClassVar[int]
    GEO_POSE_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    TRUST_FIELD_NUMBER: _ClassVar[int]
    world_from_rig: _geometry_pb2.RigidTransform
    covariance: PoseCovariance
    accuracy: Accuracy
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    world_from_session: _geometry_pb2.RigidTransform
    geo_pose: GeoPose
    arbitrary_unit: bool
    trust: float
    def __init__(self, world_from_rig: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., covariance: _Optional[_Union[PoseCovariance, _Mapping]] = ..., accuracy: _Optional[_Union[Accuracy, _Mapping]] = ..., inlier_count: _Optional[int] = ..., match_count: _Optional[int] = ..., reprojection_error_px: _Optional[float] = ..., world_from_session: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., geo_pose: _Optional[_Union[GeoPose, _Mapping]] = ..., arbitrary_unit: bool = ..., trust: _Optional[float] = ...) -> None: ...

class ImageReport(_message.Message):
    __slots__ = ("inlier_count", "match_count", "alone", "diagnostics", "prior_checks", "used_intrinsics")
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    ALONE_FIELD_NUMBER: _ClassVar[int]
    DIAGNOSTICS_FIELD_NUMBER: _ClassVar[int]
    PRIOR_CHECKS_FIELD_NUMBER: _ClassVar[int]
    USED_INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    inlier_count: int
    match_count: int
    alone: Rejection
    diagnostics: Diagnostics
    prior_checks: _containers.RepeatedCompositeFieldContainer[PriorCheck]
    used_intrinsics: UsedIntrinsics
    def __init__(self, inlier_count: _Optional[int] = ..., match_count: _Optional[int] = ..., alone: _Optional[_Union[Rejection, _Mapping]] = ..., diagnostics: _Optional[_Union[Diagnostics, _Mapping]] = ..., prior_checks: _Optional[_Iterable[_Union[PriorCheck, _Mapping]]] = ..., used_intrinsics: _Optional[_Union[UsedIntrinsics, _Mapping]] = ...) -> None: ...

class LocalizeSequenceRequest(_message.Message):
    __slots__ = ("scene", "frames", "estimate_session_scale", "options", "scenes", "scene_group", "prior_scene")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    ESTIMATE_SESSION_SCALE_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    SCENES_FIELD_NUMBER: _ClassVar[int]
    SCENE_GROUP_FIELD_NUMBER: _ClassVar[int]
    PRIOR_SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    frames: _containers.RepeatedCompositeFieldContainer[SequenceFrame]
    estimate_session_scale: bool
    options: LocalizeOptions
    scenes: _containers.RepeatedScalarFieldContainer[str]
    scene_group: SceneGroup
    prior_scene: str
    def __init__(self, scene: _Optional[str] = ..., frames: _Optional[_Iterable[_Union[SequenceFrame, _Mapping]]] = ..., estimate_session_scale: bool = ..., options: _Optional[_Union[LocalizeOptions, _Mapping]] = ..., scenes: _Optional[_Iterable[str]] = ..., scene_group: _Optional[_Union[SceneGroup, _Mapping]] = ..., prior_scene: _Optional[str] = ...) -> None: ...

class SequenceFrame(_message.Message):
    __slots__ = ("image", "intrinsics", "session_from_camera", "capture_time", "references", "position_prior", "heading_prior", "geo_position_prior", "gravity_prior", "pose_prior", "mask", "depth", "intrinsics_uncertainty")
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    SESSION_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    HEADING_PRIOR_FIELD_NUMBER: _ClassVar[int]
    GEO_POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_PRIOR_FIELD_NUMBER: _ClassVar[int]
    POSE_PRIOR_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_UNCERTAINTY_FIELD_NUMBER: _ClassVar[int]
    image: bytes
    intrinsics: _geometry_pb2.CameraIntrinsics
    session_from_camera: _geometry_pb2.RigidTransform
    capture_time: _timestamp_pb2.Timestamp
    references: _containers.RepeatedScalarFieldContainer[str]
    position_prior: PositionPrior
    heading_prior: HeadingPrior
    geo_position_prior: GeoPositionPrior
    gravity_prior: GravityPrior
    pose_prior: PosePrior
    mask: bytes
    depth: _geometry_pb2.DepthImage
    intrinsics_uncertainty: IntrinsicsUncertainty
    def __init__(self, image: _Optional[bytes] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., session_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., references: _Optional[_Iterable[str]] = ..., position_prior: _Optional[_Union[PositionPrior, _Mapping]] = ..., heading_prior: _Optional[_Union[HeadingPrior, _Mapping]] = ..., geo_position_prior: _Optional[_Union[GeoPositionPrior, _Mapping]] = ..., gravity_prior: _Optional[_Union[GravityPrior, _Mapping]] = ..., pose_prior: _Optional[_Union[PosePrior, _Mapping]] = ..., mask: _Optional[bytes] = ..., depth: _Optional[_Union[_geometry_pb2.DepthImage, _Mapping]] = ..., intrinsics_uncertainty: _Optional[_Union[IntrinsicsUncertainty, _Mapping]] = ...) -> None: ...

class LocalizeSequenceResponse(_message.Message):
    __slots__ = ("localization", "rejection", "images", "scene")
    LOCALIZATION_FIELD_NUMBER: _ClassVar[int]
    REJECTION_FIELD_NUMBER: _ClassVar[int]
    IMAGES_FIELD_NUMBER: _ClassVar[int]
    SCENE_FIELD_NUMBER: _ClassVar[int]
    localization: SequenceLocalization
    rejection: Rejection
    images: _containers.RepeatedCompositeFieldContainer[ImageReport]
    scene: str
    def __init__(self, localization: _Optional[_Union[SequenceLocalization, _Mapping]] = ..., rejection: _Optional[_Union[Rejection, _Mapping]] = ..., images: _Optional[_Iterable[_Union[ImageReport, _Mapping]]] = ..., scene: _Optional[str] = ...) -> None: ...

class SequenceLocalization(_message.Message):
    __slots__ = ("world_from_session", "session_scale", "session_scale_sigma", "poses", "covariance", "accuracy", "inlier_count", "match_count", "reprojection_error_px", "axes", "arbitrary_unit", "jumps", "trust")
    WORLD_FROM_SESSION_FIELD_NUMBER: _ClassVar[int]
    SESSION_SCALE_FIELD_NUMBER: _ClassVar[int]
    SESSION_SCALE_SIGMA_FIELD_NUMBER: _ClassVar[int]
    POSES_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    ACCURACY_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    REPROJECTION_ERROR_PX_FIELD_NUMBER: _ClassVar[int]
    AXES_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    JUMPS_FIELD_NUMBER: _ClassVar[int]
    TRUST_FIELD_NUMBER: _ClassVar[int]
    world_from_session: _geometry_pb2.RigidTransform
    session_scale: float
    session_scale_sigma: float
    poses: _containers.RepeatedCompositeFieldContainer[CapturedPose]
    covariance: PoseCovariance
    accuracy: Accuracy
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    axes: Axes
    arbitrary_unit: bool
    jumps: _containers.RepeatedCompositeFieldContainer[TrackingJump]
    trust: float
    def __init__(self, world_from_session: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., session_scale: _Optional[float] = ..., session_scale_sigma: _Optional[float] = ..., poses: _Optional[_Iterable[_Union[CapturedPose, _Mapping]]] = ..., covariance: _Optional[_Union[PoseCovariance, _Mapping]] = ..., accuracy: _Optional[_Union[Accuracy, _Mapping]] = ..., inlier_count: _Optional[int] = ..., match_count: _Optional[int] = ..., reprojection_error_px: _Optional[float] = ..., axes: _Optional[_Union[Axes, str]] = ..., arbitrary_unit: bool = ..., jumps: _Optional[_Iterable[_Union[TrackingJump, _Mapping]]] = ..., trust: _Optional[float] = ...) -> None: ...

class TrackingJump(_message.Message):
    __slots__ = ("before", "after", "shift_m", "rotation_deg")
    BEFORE_FIELD_NUMBER: _ClassVar[int]
    AFTER_FIELD_NUMBER: _ClassVar[int]
    SHIFT_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_DEG_FIELD_NUMBER: _ClassVar[int]
    before: int
    after: int
    shift_m: float
    rotation_deg: float
    def __init__(self, before: _Optional[int] = ..., after: _Optional[int] = ..., shift_m: _Optional[float] = ..., rotation_deg: _Optional[float] = ...) -> None: ...

class CapturedPose(_message.Message):
    __slots__ = ("capture_time", "world_from_camera")
    CAPTURE_TIME_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    capture_time: _timestamp_pb2.Timestamp
    world_from_camera: _geometry_pb2.RigidTransform
    def __init__(self, capture_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ...) -> None: ...

class WatchQueriesRequest(_message.Message):
    __slots__ = ("scene",)
    SCENE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    def __init__(self, scene: _Optional[str] = ...) -> None: ...

class WatchQueriesResponse(_message.Message):
    __slots__ = ("image", "intrinsics", "answer", "missed_count")
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    ANSWER_FIELD_NUMBER: _ClassVar[int]
    MISSED_COUNT_FIELD_NUMBER: _ClassVar[int]
    image: bytes
    intrinsics: _geometry_pb2.CameraIntrinsics
    answer: LocalizeResponse
    missed_count: int
    def __init__(self, image: _Optional[bytes] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., answer: _Optional[_Union[LocalizeResponse, _Mapping]] = ..., missed_count: _Optional[int] = ...) -> None: ...
