from google.protobuf import field_mask_pb2 as _field_mask_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from mapless.v1 import geometry_pb2 as _geometry_pb2
from mapless.v1 import localization_service_pb2 as _localization_service_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Iterable as _Iterable, Mapping as _Mapping, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class PoseSource(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    POSE_SOURCE_UNSPECIFIED: _ClassVar[PoseSource]
    POSE_SOURCE_GIVEN: _ClassVar[PoseSource]
    POSE_SOURCE_PLACED: _ClassVar[PoseSource]
    POSE_SOURCE_ADOPTED: _ClassVar[PoseSource]

class AuditVerdict(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    AUDIT_VERDICT_UNSPECIFIED: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_CONSISTENT: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_WRONG_POSE: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_WRONG_INTRINSICS: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_WRONG_POSE_AND_INTRINSICS: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_SWAPPED_IMAGE: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_DUPLICATE: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_SCENE_CHANGED: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_UNVERIFIABLE: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_WRONG_DEPTH: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_DOUBTFUL_DEPTH: _ClassVar[AuditVerdict]
    AUDIT_VERDICT_RETIRED: _ClassVar[AuditVerdict]

class ReferenceEventKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    REFERENCE_EVENT_KIND_UNSPECIFIED: _ClassVar[ReferenceEventKind]
    REFERENCE_EVENT_KIND_ADOPTED: _ClassVar[ReferenceEventKind]
    REFERENCE_EVENT_KIND_RETIRED: _ClassVar[ReferenceEventKind]

class CoverageVerdict(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    COVERAGE_VERDICT_UNSPECIFIED: _ClassVar[CoverageVerdict]
    COVERAGE_VERDICT_LOCALIZABLE: _ClassVar[CoverageVerdict]
    COVERAGE_VERDICT_DOUBTFUL: _ClassVar[CoverageVerdict]
    COVERAGE_VERDICT_NOT_LOCALIZABLE: _ClassVar[CoverageVerdict]
POSE_SOURCE_UNSPECIFIED: PoseSource
POSE_SOURCE_GIVEN: PoseSource
POSE_SOURCE_PLACED: PoseSource
POSE_SOURCE_ADOPTED: PoseSource
AUDIT_VERDICT_UNSPECIFIED: AuditVerdict
AUDIT_VERDICT_CONSISTENT: AuditVerdict
AUDIT_VERDICT_WRONG_POSE: AuditVerdict
AUDIT_VERDICT_WRONG_INTRINSICS: AuditVerdict
AUDIT_VERDICT_WRONG_POSE_AND_INTRINSICS: AuditVerdict
AUDIT_VERDICT_SWAPPED_IMAGE: AuditVerdict
AUDIT_VERDICT_DUPLICATE: AuditVerdict
AUDIT_VERDICT_SCENE_CHANGED: AuditVerdict
AUDIT_VERDICT_UNVERIFIABLE: AuditVerdict
AUDIT_VERDICT_WRONG_DEPTH: AuditVerdict
AUDIT_VERDICT_DOUBTFUL_DEPTH: AuditVerdict
AUDIT_VERDICT_RETIRED: AuditVerdict
REFERENCE_EVENT_KIND_UNSPECIFIED: ReferenceEventKind
REFERENCE_EVENT_KIND_ADOPTED: ReferenceEventKind
REFERENCE_EVENT_KIND_RETIRED: ReferenceEventKind
COVERAGE_VERDICT_UNSPECIFIED: CoverageVerdict
COVERAGE_VERDICT_LOCALIZABLE: CoverageVerdict
COVERAGE_VERDICT_DOUBTFUL: CoverageVerdict
COVERAGE_VERDICT_NOT_LOCALIZABLE: CoverageVerdict

class Scene(_message.Message):
    __slots__ = ("name", "generation", "reference_count", "create_time", "datum", "down_in_world", "calibration", "arbitrary_unit", "labels", "adoption")
    class LabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    NAME_FIELD_NUMBER: _ClassVar[int]
    GENERATION_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    CREATE_TIME_FIELD_NUMBER: _ClassVar[int]
    DATUM_FIELD_NUMBER: _ClassVar[int]
    DOWN_IN_WORLD_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    ADOPTION_FIELD_NUMBER: _ClassVar[int]
    name: str
    generation: int
    reference_count: int
    create_time: _timestamp_pb2.Timestamp
    datum: Datum
    down_in_world: _geometry_pb2.Vector3
    calibration: SceneCalibration
    arbitrary_unit: bool
    labels: _containers.ScalarMap[str, str]
    adoption: AdoptionPolicy
    def __init__(self, name: _Optional[str] = ..., generation: _Optional[int] = ..., reference_count: _Optional[int] = ..., create_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., datum: _Optional[_Union[Datum, _Mapping]] = ..., down_in_world: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., calibration: _Optional[_Union[SceneCalibration, _Mapping]] = ..., arbitrary_unit: bool = ..., labels: _Optional[_Mapping[str, str]] = ..., adoption: _Optional[_Union[AdoptionPolicy, _Mapping]] = ...) -> None: ...

class AdoptionPolicy(_message.Message):
    __slots__ = ("most_per_place", "min_trust", "max_radius_m", "min_surveyed_share")
    MOST_PER_PLACE_FIELD_NUMBER: _ClassVar[int]
    MIN_TRUST_FIELD_NUMBER: _ClassVar[int]
    MAX_RADIUS_M_FIELD_NUMBER: _ClassVar[int]
    MIN_SURVEYED_SHARE_FIELD_NUMBER: _ClassVar[int]
    most_per_place: int
    min_trust: float
    max_radius_m: float
    min_surveyed_share: float
    def __init__(self, most_per_place: _Optional[int] = ..., min_trust: _Optional[float] = ..., max_radius_m: _Optional[float] = ..., min_surveyed_share: _Optional[float] = ...) -> None: ...

class Datum(_message.Message):
    __slots__ = ("latitude_deg", "longitude_deg", "height_m", "enu_from_world")
    LATITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_M_FIELD_NUMBER: _ClassVar[int]
    ENU_FROM_WORLD_FIELD_NUMBER: _ClassVar[int]
    latitude_deg: float
    longitude_deg: float
    height_m: float
    enu_from_world: _geometry_pb2.Quaternion
    def __init__(self, latitude_deg: _Optional[float] = ..., longitude_deg: _Optional[float] = ..., height_m: _Optional[float] = ..., enu_from_world: _Optional[_Union[_geometry_pb2.Quaternion, _Mapping]] = ...) -> None: ...

class SceneCalibration(_message.Message):
    __slots__ = ("position_factor_68", "position_factor_95", "rotation_factor_68", "rotation_factor_95", "query_count", "features", "backend", "variant", "server_version", "create_time", "reference_noise_m", "reference_noise_deg", "grows_with_gap")
    POSITION_FACTOR_68_FIELD_NUMBER: _ClassVar[int]
    POSITION_FACTOR_95_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FACTOR_68_FIELD_NUMBER: _ClassVar[int]
    ROTATION_FACTOR_95_FIELD_NUMBER: _ClassVar[int]
    QUERY_COUNT_FIELD_NUMBER: _ClassVar[int]
    FEATURES_FIELD_NUMBER: _ClassVar[int]
    BACKEND_FIELD_NUMBER: _ClassVar[int]
    VARIANT_FIELD_NUMBER: _ClassVar[int]
    SERVER_VERSION_FIELD_NUMBER: _ClassVar[int]
    CREATE_TIME_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_NOISE_M_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_NOISE_DEG_FIELD_NUMBER: _ClassVar[int]
    GROWS_WITH_GAP_FIELD_NUMBER: _ClassVar[int]
    position_factor_68: float
    position_factor_95: float
    rotation_factor_68: float
    rotation_factor_95: float
    query_count: int
    features: str
    backend: str
    variant: _localization_service_pb2.Variant
    server_version: str
    create_time: _timestamp_pb2.Timestamp
    reference_noise_m: float
    reference_noise_deg: float
    grows_with_gap: bool
    def __init__(self, position_factor_68: _Optional[float] = ..., position_factor_95: _Optional[float] = ..., rotation_factor_68: _Optional[float] = ..., rotation_factor_95: _Optional[float] = ..., query_count: _Optional[int] = ..., features: _Optional[str] = ..., backend: _Optional[str] = ..., variant: _Optional[_Union[_localization_service_pb2.Variant, str]] = ..., server_version: _Optional[str] = ..., create_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., reference_noise_m: _Optional[float] = ..., reference_noise_deg: _Optional[float] = ..., grows_with_gap: bool = ...) -> None: ...

class Reference(_message.Message):
    __slots__ = ("name", "image", "intrinsics", "world_from_camera", "create_time", "image_sha256", "feature_count", "mask", "mask_sha256", "provenance", "depth", "depth_sha256", "retire_time", "retirement", "place", "place_reference")
    NAME_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    CREATE_TIME_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SHA256_FIELD_NUMBER: _ClassVar[int]
    FEATURE_COUNT_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    MASK_SHA256_FIELD_NUMBER: _ClassVar[int]
    PROVENANCE_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    DEPTH_SHA256_FIELD_NUMBER: _ClassVar[int]
    RETIRE_TIME_FIELD_NUMBER: _ClassVar[int]
    RETIREMENT_FIELD_NUMBER: _ClassVar[int]
    PLACE_FIELD_NUMBER: _ClassVar[int]
    PLACE_REFERENCE_FIELD_NUMBER: _ClassVar[int]
    name: str
    image: bytes
    intrinsics: _geometry_pb2.CameraIntrinsics
    world_from_camera: _geometry_pb2.RigidTransform
    create_time: _timestamp_pb2.Timestamp
    image_sha256: str
    feature_count: int
    mask: bytes
    mask_sha256: str
    provenance: Provenance
    depth: _geometry_pb2.DepthImage
    depth_sha256: str
    retire_time: _timestamp_pb2.Timestamp
    retirement: str
    place: PlaceState
    place_reference: str
    def __init__(self, name: _Optional[str] = ..., image: _Optional[bytes] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., create_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., image_sha256: _Optional[str] = ..., feature_count: _Optional[int] = ..., mask: _Optional[bytes] = ..., mask_sha256: _Optional[str] = ..., provenance: _Optional[_Union[Provenance, _Mapping]] = ..., depth: _Optional[_Union[_geometry_pb2.DepthImage, _Mapping]] = ..., depth_sha256: _Optional[str] = ..., retire_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., retirement: _Optional[str] = ..., place: _Optional[_Union[PlaceState, _Mapping]] = ..., place_reference: _Optional[str] = ...) -> None: ...

class PlaceState(_message.Message):
    __slots__ = ("surveyed_share", "photograph_count", "contradiction_count", "is_outdated")
    SURVEYED_SHARE_FIELD_NUMBER: _ClassVar[int]
    PHOTOGRAPH_COUNT_FIELD_NUMBER: _ClassVar[int]
    CONTRADICTION_COUNT_FIELD_NUMBER: _ClassVar[int]
    IS_OUTDATED_FIELD_NUMBER: _ClassVar[int]
    surveyed_share: float
    photograph_count: int
    contradiction_count: int
    is_outdated: bool
    def __init__(self, surveyed_share: _Optional[float] = ..., photograph_count: _Optional[int] = ..., contradiction_count: _Optional[int] = ..., is_outdated: bool = ...) -> None: ...

class Provenance(_message.Message):
    __slots__ = ("source", "accuracy", "surveyed_share", "vouchers", "covariance", "adopt_time")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    ACCURACY_FIELD_NUMBER: _ClassVar[int]
    SURVEYED_SHARE_FIELD_NUMBER: _ClassVar[int]
    VOUCHERS_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    ADOPT_TIME_FIELD_NUMBER: _ClassVar[int]
    source: PoseSource
    accuracy: _localization_service_pb2.Accuracy
    surveyed_share: float
    vouchers: _containers.RepeatedCompositeFieldContainer[Voucher]
    covariance: _localization_service_pb2.PoseCovariance
    adopt_time: _timestamp_pb2.Timestamp
    def __init__(self, source: _Optional[_Union[PoseSource, str]] = ..., accuracy: _Optional[_Union[_localization_service_pb2.Accuracy, _Mapping]] = ..., surveyed_share: _Optional[float] = ..., vouchers: _Optional[_Iterable[_Union[Voucher, _Mapping]]] = ..., covariance: _Optional[_Union[_localization_service_pb2.PoseCovariance, _Mapping]] = ..., adopt_time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ...) -> None: ...

class Voucher(_message.Message):
    __slots__ = ("reference_id", "match_count")
    REFERENCE_ID_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    reference_id: str
    match_count: int
    def __init__(self, reference_id: _Optional[str] = ..., match_count: _Optional[int] = ...) -> None: ...

class CreateSceneRequest(_message.Message):
    __slots__ = ("scene_id", "datum", "down_in_world", "arbitrary_unit", "labels", "adoption")
    class LabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    SCENE_ID_FIELD_NUMBER: _ClassVar[int]
    DATUM_FIELD_NUMBER: _ClassVar[int]
    DOWN_IN_WORLD_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    ADOPTION_FIELD_NUMBER: _ClassVar[int]
    scene_id: str
    datum: Datum
    down_in_world: _geometry_pb2.Vector3
    arbitrary_unit: bool
    labels: _containers.ScalarMap[str, str]
    adoption: AdoptionPolicy
    def __init__(self, scene_id: _Optional[str] = ..., datum: _Optional[_Union[Datum, _Mapping]] = ..., down_in_world: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., arbitrary_unit: bool = ..., labels: _Optional[_Mapping[str, str]] = ..., adoption: _Optional[_Union[AdoptionPolicy, _Mapping]] = ...) -> None: ...

class CreateSceneResponse(_message.Message):
    __slots__ = ("scene", "warnings")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    scene: Scene
    warnings: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, scene: _Optional[_Union[Scene, _Mapping]] = ..., warnings: _Optional[_Iterable[str]] = ...) -> None: ...

class GetSceneRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class GetSceneResponse(_message.Message):
    __slots__ = ("scene", "warnings", "contradiction", "compared_pair_count", "agreeing_pair_count", "pending_work", "adopted_reference_count", "retired_reference_count")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    CONTRADICTION_FIELD_NUMBER: _ClassVar[int]
    COMPARED_PAIR_COUNT_FIELD_NUMBER: _ClassVar[int]
    AGREEING_PAIR_COUNT_FIELD_NUMBER: _ClassVar[int]
    PENDING_WORK_FIELD_NUMBER: _ClassVar[int]
    ADOPTED_REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    RETIRED_REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    scene: Scene
    warnings: _containers.RepeatedScalarFieldContainer[str]
    contradiction: str
    compared_pair_count: int
    agreeing_pair_count: int
    pending_work: _containers.RepeatedCompositeFieldContainer[PendingWork]
    adopted_reference_count: int
    retired_reference_count: int
    def __init__(self, scene: _Optional[_Union[Scene, _Mapping]] = ..., warnings: _Optional[_Iterable[str]] = ..., contradiction: _Optional[str] = ..., compared_pair_count: _Optional[int] = ..., agreeing_pair_count: _Optional[int] = ..., pending_work: _Optional[_Iterable[_Union[PendingWork, _Mapping]]] = ..., adopted_reference_count: _Optional[int] = ..., retired_reference_count: _Optional[int] = ...) -> None: ...

class PendingWork(_message.Message):
    __slots__ = ("kind", "name", "reference_count")
    KIND_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_COUNT_FIELD_NUMBER: _ClassVar[int]
    kind: str
    name: str
    reference_count: int
    def __init__(self, kind: _Optional[str] = ..., name: _Optional[str] = ..., reference_count: _Optional[int] = ...) -> None: ...

class UpdateSceneRequest(_message.Message):
    __slots__ = ("scene", "update_mask")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    UPDATE_MASK_FIELD_NUMBER: _ClassVar[int]
    scene: Scene
    update_mask: _field_mask_pb2.FieldMask
    def __init__(self, scene: _Optional[_Union[Scene, _Mapping]] = ..., update_mask: _Optional[_Union[_field_mask_pb2.FieldMask, _Mapping]] = ...) -> None: ...

class UpdateSceneResponse(_message.Message):
    __slots__ = ("scene", "warnings")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    scene: Scene
    warnings: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, scene: _Optional[_Union[Scene, _Mapping]] = ..., warnings: _Optional[_Iterable[str]] = ...) -> None: ...

class ListScenesRequest(_message.Message):
    __slots__ = ("page_size", "page_token", "labels")
    class LabelsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    LABELS_FIELD_NUMBER: _ClassVar[int]
    page_size: int
    page_token: str
    labels: _containers.ScalarMap[str, str]
    def __init__(self, page_size: _Optional[int] = ..., page_token: _Optional[str] = ..., labels: _Optional[_Mapping[str, str]] = ...) -> None: ...

class ListScenesResponse(_message.Message):
    __slots__ = ("scenes", "next_page_token")
    SCENES_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    scenes: _containers.RepeatedCompositeFieldContainer[Scene]
    next_page_token: str
    def __init__(self, scenes: _Optional[_Iterable[_Union[Scene, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class DeleteSceneRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class DeleteSceneResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class CreateReferenceRequest(_message.Message):
    __slots__ = ("scene", "reference_id", "reference")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_ID_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    reference_id: str
    reference: Reference
    def __init__(self, scene: _Optional[str] = ..., reference_id: _Optional[str] = ..., reference: _Optional[_Union[Reference, _Mapping]] = ...) -> None: ...

class CreateReferenceResponse(_message.Message):
    __slots__ = ("reference", "warnings")
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    reference: Reference
    warnings: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, reference: _Optional[_Union[Reference, _Mapping]] = ..., warnings: _Optional[_Iterable[str]] = ...) -> None: ...

class BatchCreateReferencesRequest(_message.Message):
    __slots__ = ("scene", "requests")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    requests: _containers.RepeatedCompositeFieldContainer[CreateReferenceRequest]
    def __init__(self, scene: _Optional[str] = ..., requests: _Optional[_Iterable[_Union[CreateReferenceRequest, _Mapping]]] = ...) -> None: ...

class BatchCreateReferencesResponse(_message.Message):
    __slots__ = ("references", "warnings")
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    WARNINGS_FIELD_NUMBER: _ClassVar[int]
    references: _containers.RepeatedCompositeFieldContainer[Reference]
    warnings: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, references: _Optional[_Iterable[_Union[Reference, _Mapping]]] = ..., warnings: _Optional[_Iterable[str]] = ...) -> None: ...

class GetReferenceRequest(_message.Message):
    __slots__ = ("name", "include_image")
    NAME_FIELD_NUMBER: _ClassVar[int]
    INCLUDE_IMAGE_FIELD_NUMBER: _ClassVar[int]
    name: str
    include_image: bool
    def __init__(self, name: _Optional[str] = ..., include_image: bool = ...) -> None: ...

class GetReferenceResponse(_message.Message):
    __slots__ = ("reference",)
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    reference: Reference
    def __init__(self, reference: _Optional[_Union[Reference, _Mapping]] = ...) -> None: ...

class ListReferencesRequest(_message.Message):
    __slots__ = ("scene", "page_size", "page_token", "only_adopted", "only_retired")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    ONLY_ADOPTED_FIELD_NUMBER: _ClassVar[int]
    ONLY_RETIRED_FIELD_NUMBER: _ClassVar[int]
    scene: str
    page_size: int
    page_token: str
    only_adopted: bool
    only_retired: bool
    def __init__(self, scene: _Optional[str] = ..., page_size: _Optional[int] = ..., page_token: _Optional[str] = ..., only_adopted: bool = ..., only_retired: bool = ...) -> None: ...

class ListReferencesResponse(_message.Message):
    __slots__ = ("references", "next_page_token")
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    references: _containers.RepeatedCompositeFieldContainer[Reference]
    next_page_token: str
    def __init__(self, references: _Optional[_Iterable[_Union[Reference, _Mapping]]] = ..., next_page_token: _Optional[str] = ...) -> None: ...

class DeleteReferenceRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class DeleteReferenceResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class RetireReferenceRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class RetireReferenceResponse(_message.Message):
    __slots__ = ("reference",)
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    reference: Reference
    def __init__(self, reference: _Optional[_Union[Reference, _Mapping]] = ...) -> None: ...

class RestoreReferencesRequest(_message.Message):
    __slots__ = ("scene", "since", "place")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    SINCE_FIELD_NUMBER: _ClassVar[int]
    PLACE_FIELD_NUMBER: _ClassVar[int]
    scene: str
    since: _timestamp_pb2.Timestamp
    place: str
    def __init__(self, scene: _Optional[str] = ..., since: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., place: _Optional[str] = ...) -> None: ...

class RestoreReferencesResponse(_message.Message):
    __slots__ = ("references", "still_retired")
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    STILL_RETIRED_FIELD_NUMBER: _ClassVar[int]
    references: _containers.RepeatedScalarFieldContainer[str]
    still_retired: _containers.RepeatedCompositeFieldContainer[StillRetired]
    def __init__(self, references: _Optional[_Iterable[str]] = ..., still_retired: _Optional[_Iterable[_Union[StillRetired, _Mapping]]] = ...) -> None: ...

class StillRetired(_message.Message):
    __slots__ = ("name", "reason")
    NAME_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    name: str
    reason: str
    def __init__(self, name: _Optional[str] = ..., reason: _Optional[str] = ...) -> None: ...

class RestoreReferenceRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class RestoreReferenceResponse(_message.Message):
    __slots__ = ("reference",)
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    reference: Reference
    def __init__(self, reference: _Optional[_Union[Reference, _Mapping]] = ...) -> None: ...

class RetrieveReferencesRequest(_message.Message):
    __slots__ = ("scene", "image", "intrinsics", "count", "position_prior", "heading_prior", "mask")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    POSITION_PRIOR_FIELD_NUMBER: _ClassVar[int]
    HEADING_PRIOR_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    scene: str
    image: bytes
    intrinsics: _geometry_pb2.CameraIntrinsics
    count: int
    position_prior: _localization_service_pb2.PositionPrior
    heading_prior: _localization_service_pb2.HeadingPrior
    mask: bytes
    def __init__(self, scene: _Optional[str] = ..., image: _Optional[bytes] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ..., count: _Optional[int] = ..., position_prior: _Optional[_Union[_localization_service_pb2.PositionPrior, _Mapping]] = ..., heading_prior: _Optional[_Union[_localization_service_pb2.HeadingPrior, _Mapping]] = ..., mask: _Optional[bytes] = ...) -> None: ...

class RetrieveReferencesResponse(_message.Message):
    __slots__ = ("references", "retrieval", "store_generation")
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    RETRIEVAL_FIELD_NUMBER: _ClassVar[int]
    STORE_GENERATION_FIELD_NUMBER: _ClassVar[int]
    references: _containers.RepeatedCompositeFieldContainer[RetrievedReference]
    retrieval: str
    store_generation: int
    def __init__(self, references: _Optional[_Iterable[_Union[RetrievedReference, _Mapping]]] = ..., retrieval: _Optional[str] = ..., store_generation: _Optional[int] = ...) -> None: ...

class RetrievedReference(_message.Message):
    __slots__ = ("name", "similarity", "world_from_camera")
    NAME_FIELD_NUMBER: _ClassVar[int]
    SIMILARITY_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    name: str
    similarity: float
    world_from_camera: _geometry_pb2.RigidTransform
    def __init__(self, name: _Optional[str] = ..., similarity: _Optional[float] = ..., world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ...) -> None: ...

class AuditSceneRequest(_message.Message):
    __slots__ = ("scene", "references", "page_size", "page_token")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    PAGE_SIZE_FIELD_NUMBER: _ClassVar[int]
    PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    scene: str
    references: _containers.RepeatedScalarFieldContainer[str]
    page_size: int
    page_token: str
    def __init__(self, scene: _Optional[str] = ..., references: _Optional[_Iterable[str]] = ..., page_size: _Optional[int] = ..., page_token: _Optional[str] = ...) -> None: ...

class AuditSceneResponse(_message.Message):
    __slots__ = ("audits", "next_page_token", "store_generation")
    AUDITS_FIELD_NUMBER: _ClassVar[int]
    NEXT_PAGE_TOKEN_FIELD_NUMBER: _ClassVar[int]
    STORE_GENERATION_FIELD_NUMBER: _ClassVar[int]
    audits: _containers.RepeatedCompositeFieldContainer[ReferenceAudit]
    next_page_token: str
    store_generation: int
    def __init__(self, audits: _Optional[_Iterable[_Union[ReferenceAudit, _Mapping]]] = ..., next_page_token: _Optional[str] = ..., store_generation: _Optional[int] = ...) -> None: ...

class ReferenceAudit(_message.Message):
    __slots__ = ("name", "verdict", "message", "neighbour_count", "match_count", "inlier_count", "reprojection_error_px", "position_offset_m", "rotation_offset_deg", "focal_ratio", "other", "provenance")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    NEIGHBOUR_COUNT_FIELD_NUMBER: _ClassVar[int]
    MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    REPROJECTION_ERROR_PX_FIELD_NUMBER: _ClassVar[int]
    POSITION_OFFSET_M_FIELD_NUMBER: _ClassVar[int]
    ROTATION_OFFSET_DEG_FIELD_NUMBER: _ClassVar[int]
    FOCAL_RATIO_FIELD_NUMBER: _ClassVar[int]
    OTHER_FIELD_NUMBER: _ClassVar[int]
    PROVENANCE_FIELD_NUMBER: _ClassVar[int]
    name: str
    verdict: AuditVerdict
    message: str
    neighbour_count: int
    match_count: int
    inlier_count: int
    reprojection_error_px: float
    position_offset_m: float
    rotation_offset_deg: float
    focal_ratio: float
    other: str
    provenance: Provenance
    def __init__(self, name: _Optional[str] = ..., verdict: _Optional[_Union[AuditVerdict, str]] = ..., message: _Optional[str] = ..., neighbour_count: _Optional[int] = ..., match_count: _Optional[int] = ..., inlier_count: _Optional[int] = ..., reprojection_error_px: _Optional[float] = ..., position_offset_m: _Optional[float] = ..., rotation_offset_deg: _Optional[float] = ..., focal_ratio: _Optional[float] = ..., other: _Optional[str] = ..., provenance: _Optional[_Union[Provenance, _Mapping]] = ...) -> None: ...

class GetSceneReportRequest(_message.Message):
    __slots__ = ("scene", "first_day", "last_day", "days_per_period")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    FIRST_DAY_FIELD_NUMBER: _ClassVar[int]
    LAST_DAY_FIELD_NUMBER: _ClassVar[int]
    DAYS_PER_PERIOD_FIELD_NUMBER: _ClassVar[int]
    scene: str
    first_day: str
    last_day: str
    days_per_period: int
    def __init__(self, scene: _Optional[str] = ..., first_day: _Optional[str] = ..., last_day: _Optional[str] = ..., days_per_period: _Optional[int] = ...) -> None: ...

class GetSceneReportResponse(_message.Message):
    __slots__ = ("report",)
    REPORT_FIELD_NUMBER: _ClassVar[int]
    report: SceneReport
    def __init__(self, report: _Optional[_Union[SceneReport, _Mapping]] = ...) -> None: ...

class SceneReport(_message.Message):
    __slots__ = ("scene", "first_day", "last_day", "periods", "places", "omitted_place_count", "suggestions", "events", "arbitrary_unit")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    FIRST_DAY_FIELD_NUMBER: _ClassVar[int]
    LAST_DAY_FIELD_NUMBER: _ClassVar[int]
    PERIODS_FIELD_NUMBER: _ClassVar[int]
    PLACES_FIELD_NUMBER: _ClassVar[int]
    OMITTED_PLACE_COUNT_FIELD_NUMBER: _ClassVar[int]
    SUGGESTIONS_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    scene: str
    first_day: str
    last_day: str
    periods: _containers.RepeatedCompositeFieldContainer[PeriodCounts]
    places: _containers.RepeatedCompositeFieldContainer[PlaceReport]
    omitted_place_count: int
    suggestions: _containers.RepeatedCompositeFieldContainer[ReferenceSuggestion]
    events: _containers.RepeatedCompositeFieldContainer[ReferenceEvent]
    arbitrary_unit: bool
    def __init__(self, scene: _Optional[str] = ..., first_day: _Optional[str] = ..., last_day: _Optional[str] = ..., periods: _Optional[_Iterable[_Union[PeriodCounts, _Mapping]]] = ..., places: _Optional[_Iterable[_Union[PlaceReport, _Mapping]]] = ..., omitted_place_count: _Optional[int] = ..., suggestions: _Optional[_Iterable[_Union[ReferenceSuggestion, _Mapping]]] = ..., events: _Optional[_Iterable[_Union[ReferenceEvent, _Mapping]]] = ..., arbitrary_unit: bool = ...) -> None: ...

class PeriodCounts(_message.Message):
    __slots__ = ("first_day", "last_day", "localized_count", "rejections", "surveyed_share", "position_68_m", "inlier_count", "adoptions", "retirements")
    class AdoptionsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    class RetirementsEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    FIRST_DAY_FIELD_NUMBER: _ClassVar[int]
    LAST_DAY_FIELD_NUMBER: _ClassVar[int]
    LOCALIZED_COUNT_FIELD_NUMBER: _ClassVar[int]
    REJECTIONS_FIELD_NUMBER: _ClassVar[int]
    SURVEYED_SHARE_FIELD_NUMBER: _ClassVar[int]
    POSITION_68_M_FIELD_NUMBER: _ClassVar[int]
    INLIER_COUNT_FIELD_NUMBER: _ClassVar[int]
    ADOPTIONS_FIELD_NUMBER: _ClassVar[int]
    RETIREMENTS_FIELD_NUMBER: _ClassVar[int]
    first_day: str
    last_day: str
    localized_count: int
    rejections: _containers.RepeatedCompositeFieldContainer[RejectionCount]
    surveyed_share: float
    position_68_m: float
    inlier_count: float
    adoptions: _containers.ScalarMap[str, int]
    retirements: _containers.ScalarMap[str, int]
    def __init__(self, first_day: _Optional[str] = ..., last_day: _Optional[str] = ..., localized_count: _Optional[int] = ..., rejections: _Optional[_Iterable[_Union[RejectionCount, _Mapping]]] = ..., surveyed_share: _Optional[float] = ..., position_68_m: _Optional[float] = ..., inlier_count: _Optional[float] = ..., adoptions: _Optional[_Mapping[str, int]] = ..., retirements: _Optional[_Mapping[str, int]] = ...) -> None: ...

class RejectionCount(_message.Message):
    __slots__ = ("reason", "count")
    REASON_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    reason: _localization_service_pb2.RejectionReason
    count: int
    def __init__(self, reason: _Optional[_Union[_localization_service_pb2.RejectionReason, str]] = ..., count: _Optional[int] = ...) -> None: ...

class PlaceReport(_message.Message):
    __slots__ = ("reference", "world_from_camera", "periods", "state", "is_outdated", "adopted_count", "retired_count", "rejected_position")
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    PERIODS_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    IS_OUTDATED_FIELD_NUMBER: _ClassVar[int]
    ADOPTED_COUNT_FIELD_NUMBER: _ClassVar[int]
    RETIRED_COUNT_FIELD_NUMBER: _ClassVar[int]
    REJECTED_POSITION_FIELD_NUMBER: _ClassVar[int]
    reference: str
    world_from_camera: _geometry_pb2.RigidTransform
    periods: _containers.RepeatedCompositeFieldContainer[PeriodCounts]
    state: PlaceState
    is_outdated: bool
    adopted_count: int
    retired_count: int
    rejected_position: RejectedPosition
    def __init__(self, reference: _Optional[str] = ..., world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., periods: _Optional[_Iterable[_Union[PeriodCounts, _Mapping]]] = ..., state: _Optional[_Union[PlaceState, _Mapping]] = ..., is_outdated: bool = ..., adopted_count: _Optional[int] = ..., retired_count: _Optional[int] = ..., rejected_position: _Optional[_Union[RejectedPosition, _Mapping]] = ...) -> None: ...

class RejectedPosition(_message.Message):
    __slots__ = ("photograph_count", "position", "forward", "spread_m")
    PHOTOGRAPH_COUNT_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    FORWARD_FIELD_NUMBER: _ClassVar[int]
    SPREAD_M_FIELD_NUMBER: _ClassVar[int]
    photograph_count: int
    position: _geometry_pb2.Vector3
    forward: _geometry_pb2.Vector3
    spread_m: float
    def __init__(self, photograph_count: _Optional[int] = ..., position: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., forward: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., spread_m: _Optional[float] = ...) -> None: ...

class ReferenceSuggestion(_message.Message):
    __slots__ = ("place", "photograph_count", "position", "forward", "distance_m", "message")
    PLACE_FIELD_NUMBER: _ClassVar[int]
    PHOTOGRAPH_COUNT_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    FORWARD_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_M_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    place: str
    photograph_count: float
    position: _geometry_pb2.Vector3
    forward: _geometry_pb2.Vector3
    distance_m: float
    message: str
    def __init__(self, place: _Optional[str] = ..., photograph_count: _Optional[float] = ..., position: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., forward: _Optional[_Union[_geometry_pb2.Vector3, _Mapping]] = ..., distance_m: _Optional[float] = ..., message: _Optional[str] = ...) -> None: ...

class ReferenceEvent(_message.Message):
    __slots__ = ("reference", "time", "kind", "message", "place")
    REFERENCE_FIELD_NUMBER: _ClassVar[int]
    TIME_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    PLACE_FIELD_NUMBER: _ClassVar[int]
    reference: str
    time: _timestamp_pb2.Timestamp
    kind: ReferenceEventKind
    message: str
    place: str
    def __init__(self, reference: _Optional[str] = ..., time: _Optional[_Union[_timestamp_pb2.Timestamp, _Mapping]] = ..., kind: _Optional[_Union[ReferenceEventKind, str]] = ..., message: _Optional[str] = ..., place: _Optional[str] = ...) -> None: ...

class CheckCoverageRequest(_message.Message):
    __slots__ = ("scene", "world_from_camera", "intrinsics")
    SCENE_FIELD_NUMBER: _ClassVar[int]
    WORLD_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    INTRINSICS_FIELD_NUMBER: _ClassVar[int]
    scene: str
    world_from_camera: _geometry_pb2.RigidTransform
    intrinsics: _geometry_pb2.CameraIntrinsics
    def __init__(self, scene: _Optional[str] = ..., world_from_camera: _Optional[_Union[_geometry_pb2.RigidTransform, _Mapping]] = ..., intrinsics: _Optional[_Union[_geometry_pb2.CameraIntrinsics, _Mapping]] = ...) -> None: ...

class CheckCoverageResponse(_message.Message):
    __slots__ = ("verdict", "message", "expected_match_count", "image_share", "position_68_m", "references", "store_generation", "arbitrary_unit")
    VERDICT_FIELD_NUMBER: _ClassVar[int]
    MESSAGE_FIELD_NUMBER: _ClassVar[int]
    EXPECTED_MATCH_COUNT_FIELD_NUMBER: _ClassVar[int]
    IMAGE_SHARE_FIELD_NUMBER: _ClassVar[int]
    POSITION_68_M_FIELD_NUMBER: _ClassVar[int]
    REFERENCES_FIELD_NUMBER: _ClassVar[int]
    STORE_GENERATION_FIELD_NUMBER: _ClassVar[int]
    ARBITRARY_UNIT_FIELD_NUMBER: _ClassVar[int]
    verdict: CoverageVerdict
    message: str
    expected_match_count: int
    image_share: float
    position_68_m: float
    references: _containers.RepeatedScalarFieldContainer[str]
    store_generation: int
    arbitrary_unit: bool
    def __init__(self, verdict: _Optional[_Union[CoverageVerdict, str]] = ..., message: _Optional[str] = ..., expected_match_count: _Optional[int] = ..., image_share: _Optional[float] = ..., position_68_m: _Optional[float] = ..., references: _Optional[_Iterable[str]] = ..., store_generation: _Optional[int] = ..., arbitrary_unit: bool = ...) -> None: ...
