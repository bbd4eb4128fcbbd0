"""Conversion between the rows of the tables and `records`; checks everything that is read."""

import hashlib
import time
import uuid
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Row

from mapless.depth import DepthImage
from mapless.provenance import ADOPTED
from mapless_server.errors import DataLoss
from mapless_server.method.features.views import View
from mapless_server.security import SceneKey, scene_id_of

from . import codec
from .attributes import SceneAttributes, SelfCalibration
from .depth_images import decode_depth_image
from .records import (
    DescribedReference,
    IndexedReference,
    NewReference,
    ReferenceRecord,
    Retirement,
    RetirementReason,
    SceneRecord,
    Standing,
)

_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_MICROSECOND = timedelta(microseconds=1)

SMALL_FEATURES = "+8bit"
"""Suffix of the extractor in the table `features` where descriptors have 8 bits, which 0.2.0 cannot read."""


def time_us(time: datetime) -> int:
    """Converts a time to microseconds since 1970; databases differ in how they store time zones."""
    return (time - _EPOCH) // _MICROSECOND


def time_of(time_us: int) -> datetime:
    """Inverse of `time_us`."""
    return _EPOCH + time_us * _MICROSECOND


def now_us() -> int:
    """The present time, microseconds since 1970."""
    return round(time.time() * 1e6)


def scene_record(row: Row[Any], labels: Mapping[str, str]) -> SceneRecord:
    """Makes the record of a row of `queries.select_scenes`; raises DataLoss if the attributes are damaged."""
    key, created = SceneKey(row.scene_id), time_of(row.create_time_us)
    return SceneRecord(key, row.generation, row.reference_count, created, scene_attributes(row), labels)


def attributes_row(scene_key: SceneKey, attributes: SceneAttributes) -> dict[str, Any]:
    """Makes columns of the table `scene`."""
    data = codec.encode_attributes(attributes)
    sha256 = None if data is None else codec.sha256_for(attributes_owner(scene_key), data)
    return {"attributes": data, "attributes_sha256": sha256}


def scene_attributes(row: Row[Any]) -> SceneAttributes:
    """Reads attributes from a row of the table `scene`; raises DataLoss if they are damaged."""
    try:
        return codec.decode_attributes(attributes_owner(row.scene_id), row.attributes, row.attributes_sha256)
    except codec.Damaged as error:
        scene_id = scene_id_of(SceneKey(row.scene_id))
        raise DataLoss(
            f"scene {scene_id!r} is damaged in the store ({error}); set all three and the unit again"
        ) from error


def self_calibration(row: Row[Any]) -> SelfCalibration | None:
    """Reads a row of the table `scene_calibration`; None if it is damaged, since answers are possible without it."""
    try:
        return codec.decode_calibration(calibration_owner(row.scene_id, row.kind), row.data, row.sha256)
    except codec.Damaged:
        return None


def answered_attributes(row: Row[Any], found: Sequence[Row[Any]]) -> SceneAttributes:
    """As `scene_attributes`, with the self-calibrations of rows of `scene_calibration` that are not damaged."""
    calibrations = tuple(it for it in map(self_calibration, found) if it is not None)
    return replace(scene_attributes(row), self_calibrations=calibrations)


def calibration_owner(scene_key: str, kind: str) -> str:
    """Owner of a self-calibration, for `codec.sha256_for`."""
    return f"calibration {scene_key} {kind}"


def attributes_owner(scene_key: str) -> str:
    """Owner of a scene's attributes, for `codec.sha256_for`; no reference's key contains a space."""
    return f"scene {scene_key}"


def new_record(scene_key: SceneKey, new: NewReference, create_time: datetime) -> ReferenceRecord:
    """The record of a reference about to be stored, with a new key; ValueError if it has no features."""
    if not new.views:
        raise ValueError(f"reference {new.reference_id!r} has no features of any extractor")
    provenance = new.provenance
    if provenance.source == ADOPTED and provenance.adopt_time is None:
        provenance = replace(provenance, adopt_time=create_time)
    return ReferenceRecord(
        scene_key=scene_key,
        reference_id=new.reference_id,
        key=uuid.uuid4().hex,
        camera=new.camera,
        world_from_camera=new.world_from_camera,
        image_sha256=hashlib.sha256(new.image).hexdigest(),
        feature_count=len(next(iter(new.views.values())).features),
        create_time=create_time,
        mask_sha256=hashlib.sha256(new.mask).hexdigest() if new.mask else "",
        provenance=provenance,
        depth_sha256="" if new.depth is None else new.depth.sha256,
    )


def reference_row(record: ReferenceRecord) -> dict[str, Any]:
    """Makes a row of the table `reference`, without the generation; raises ValueError if a number is not finite."""
    geometry = codec.encode_geometry(record.camera, record.world_from_camera, record.provenance)
    return {
        "key": record.key,
        "scene_id": record.scene_key,
        "reference_id": record.reference_id,
        "geometry": geometry,
        "geometry_sha256": codec.sha256_for(record.key, geometry),
        "image_sha256": record.image_sha256,
        "feature_count": record.feature_count,
        "create_time_us": time_us(record.create_time),
        "mask_sha256": record.mask_sha256 or None,
        "depth_sha256": record.depth_sha256 or None,
    }


def reference_record(row: Row[Any]) -> ReferenceRecord:
    """Reads a row of the table `reference`; raises DataLoss if it is damaged."""
    try:
        camera, world_from_camera, provenance = codec.decode_geometry(row.key, row.geometry, row.geometry_sha256)
    except codec.Damaged as error:
        raise data_loss(row.reference_id, str(error)) from error
    return ReferenceRecord(
        scene_key=SceneKey(row.scene_id),
        reference_id=row.reference_id,
        key=row.key,
        camera=camera,
        world_from_camera=world_from_camera,
        image_sha256=row.image_sha256,
        feature_count=row.feature_count,
        create_time=time_of(row.create_time_us),
        mask_sha256=row.mask_sha256 or "",
        provenance=provenance,
        depth_sha256=row.depth_sha256 or "",
        retired=retirement(row),
        standing=None if getattr(row, "photograph_count", None) is None else standing(row),
        place_id=getattr(row, "place_id", None) or "",
    )


def standing(row: Row[Any]) -> Standing:
    """Reads columns of the table `reference_standing`."""
    return Standing(
        row.contradiction_count,
        row.contradiction_time_us,
        row.surveyed_share,
        row.photograph_count,
        tuple(row.contradicted_by.split()),
        tuple(row.surveyed_by.split()),
        row.outdate_time_us,
    )


def retirement(row: Row[Any]) -> Retirement | None:
    """Since when and why a reference is retired, if the row has columns of the table `reference_standing`."""
    if getattr(row, "retire_time_us", None) is None:
        return None
    return Retirement(time_of(row.retire_time_us), RetirementReason(row.retire_reason))


def adopted_row(record: ReferenceRecord, new: NewReference) -> dict[str, Any]:
    """Makes a row of the table `adopted_reference`."""
    return {
        "reference_key": record.key,
        "place_key": new.place_key,
        "usefulness": new.usefulness,
        "adopt_time_us": time_us(record.provenance.adopt_time or record.create_time),
        "adopted_by": new.adopted_by,
    }


def feature_names(extractor: str) -> tuple[str, str]:
    """Names under which an extractor's features are stored: in 8 bits, and as float32, as 0.2.0 did."""
    return extractor + SMALL_FEATURES, extractor


def features_row(key: str, extractor: str, view: View) -> dict[str, Any]:
    """Makes a row of the table `features`; raises ValueError as `codec.encode_view` does."""
    data = codec.encode_view(view)
    small, large = feature_names(extractor)
    name = small if view.features.descriptors.dtype.itemsize == 1 else large
    sha256 = codec.sha256_for(features_owner(key, name), data)
    return {"reference_key": key, "extractor": name, "data": data, "sha256": sha256}


def descriptor_row(key: str, name: str, vector: NDArray[np.float32]) -> dict[str, Any]:
    """Makes a row of the table `global_descriptor`; raises ValueError unless it is a finite vector."""
    data = codec.encode_descriptor(vector)
    sha256 = codec.sha256_for(descriptor_owner(key, name), data)
    return {"reference_key": key, "name": name, "data": data, "sha256": sha256}


def features_owner(key: str, extractor: str) -> str:
    """Owner of features, for `codec.sha256_for`."""
    return f"{key}/{extractor}"


def descriptor_owner(key: str, name: str) -> str:
    """Owner of a global descriptor, for `codec.sha256_for`."""
    return f"{key}#{name}"


def descriptors(found: Mapping[str, Row[Any]], name: str) -> dict[str, NDArray[np.float32]]:
    """Reads rows of `queries.descriptors_by_key`; damaged ones are left out."""
    intact = dict[str, bytes]()
    for key, row in found.items():
        with suppress(codec.Damaged):
            codec.check(descriptor_owner(key, name), row.data, row.sha256, "global descriptor")
            intact[key] = row.data
    return dict(zip(intact, codec.decode_descriptors(list(intact.values())), strict=True))


def indexed_references(found: Sequence[Row[Any]], descriptor_name: str) -> tuple[list[IndexedReference], list[str]]:
    """Reads rows of `changes.read_changes`, all at once for speed; also returns the ids of damaged ones."""
    intact = [row for row in found if _is_intact(row, descriptor_name)]
    poses = codec.decode_poses([row.geometry for row in intact])
    vectors = iter(codec.decode_descriptors([row.data for row in intact if row.sha256 is not None]))
    references = [
        IndexedReference(row.reference_id, row.key, pose, None if row.sha256 is None else next(vectors))
        for row, pose in zip(intact, poses, strict=True)
    ]
    intact_keys = {row.key for row in intact}
    return references, [row.reference_id for row in found if row.key not in intact_keys]


def _is_intact(row: Row[Any], descriptor_name: str) -> bool:
    try:
        codec.check(row.key, row.geometry, row.geometry_sha256, "camera and pose")
        if row.sha256 is not None:
            codec.check(descriptor_owner(row.key, descriptor_name), row.data, row.sha256, "global descriptor")
    except codec.Damaged:
        return False
    return True


def described_reference(row: Row[Any]) -> DescribedReference:
    """Reads a row of `queries.features_by_key`; raises DataLoss if it is damaged."""
    record = reference_record(row)
    try:
        view = codec.decode_view(features_owner(row.key, row.extractor), row.data, row.sha256)
    except codec.Damaged as error:
        raise data_loss(row.reference_id, str(error)) from error
    return DescribedReference(record, view)


def file(row: Row[Any], what: str) -> bytes:
    """Reads the file of a row of `queries.find_file`, empty for none; raises DataLoss if it is damaged or missing."""
    data: object = row.data
    if data is None and row.sha256 is None:
        return b""
    if not isinstance(data, bytes) or hashlib.sha256(data).hexdigest() != row.sha256:
        raise data_loss(row.reference_id, what)
    return data


def depth_image(row: Row[Any], what: str) -> DepthImage:
    """Reads the depth of a row of `queries.find_file`; raises DataLoss if it is damaged or missing."""
    try:
        return decode_depth_image(row.data, row.sha256 or "")
    except codec.Damaged as error:
        raise data_loss(row.reference_id, what) from error


def data_loss(reference_id: str, what: str) -> DataLoss:
    """The error of a reference whose stored bytes are damaged."""
    return DataLoss(f"reference {reference_id!r} is damaged in the store ({what}); delete it and add it again")
