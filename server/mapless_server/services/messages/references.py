"""Messages of the ReferenceService: scenes, references, pages of lists, audits, coverage."""

import base64
import binascii
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any, TypeVar

from mapless import names, wire
from mapless.depth import implausible_median
from mapless.labels import check_labels
from mapless.provenance import GIVEN, GIVEN_POSE, Provenance, provenance_from_message, provenance_to_message
from mapless.scenes import (
    Calibration,
    adoption_from_message,
    adoption_to_message,
    calibration_from_message,
    calibration_to_message,
    datum_from_message,
    datum_to_message,
    direction_from_message,
)
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb
from mapless.wire import FieldError, joined
from mapless_server.scenes import Choice, ReferenceAudit
from mapless_server.store import (
    ContradictingDown,
    DatumWithoutMetres,
    ReferenceRecord,
    Retirement,
    RetirementReason,
    SceneAttributes,
    SceneRecord,
    WrongRadius,
)

from .enums import message_of
from .queries import check_time

DEFAULT_PAGE_SIZE = 100
MAX_PAGE_SIZE = 1000

Record = TypeVar("Record")


class Page:
    """One page of a list: number of items to read, where to begin, and the token of the next page.

    A token contains the tenant, the collection and the last id of the previous page. It is opaque to callers, and valid
    only for its own list.

    Raises:
        FieldError: a negative page size, or a token of another list.
    """

    def __init__(
        self,
        request: Any,
        tenant: str,
        collection: str,
        default_size: int = DEFAULT_PAGE_SIZE,
        max_size: int = MAX_PAGE_SIZE,
    ) -> None:
        if request.page_size < 0:
            raise FieldError("page_size", f"must not be negative, is {request.page_size}")
        self._size = min(request.page_size or default_size, max_size)
        self._list = f"{tenant}\n{collection}"
        self.limit = self._size + 1  # one more shows whether there is a next page
        self.after = self._read_token(request.page_token) if request.page_token else ""

    def cut(self, records: Sequence[Record], id_of: Callable[[Record], str]) -> tuple[Sequence[Record], str]:
        """Returns the records of this page, and the token of the next one."""
        if len(records) <= self._size:
            return records, ""
        token = f"{self._list}\n{id_of(records[self._size - 1])}"
        return records[: self._size], base64.urlsafe_b64encode(token.encode()).decode()

    def _read_token(self, token: str) -> str:
        try:
            its_list, _, after = base64.b64decode(token, b"-_", validate=True).decode().rpartition("\n")
            if its_list == self._list:
                return names.check_id(after)
        except (binascii.Error, ValueError):
            pass
        raise FieldError("page_token", "must be a next_page_token of this list")


def reference_to_message(reference: ReferenceRecord) -> pb.Reference:
    """Message of a reference, without its image."""
    message = pb.Reference(
        name=names.reference_name(reference.scene_id, reference.reference_id),
        intrinsics=wire.camera_to_message(reference.camera),
        world_from_camera=wire.transform_to_message(reference.world_from_camera),
        image_sha256=reference.image_sha256,
        feature_count=reference.feature_count,
        mask_sha256=reference.mask_sha256,
        provenance=provenance_to_message(reference.provenance),
        depth_sha256=reference.depth_sha256,
    )
    if reference.retired is not None:
        message.retire_time.FromDatetime(reference.retired.time)
        message.retirement = retirement_of(reference.retired)
    if reference.place_id:
        message.place_reference = names.reference_name(reference.scene_id, reference.place_id)
    known = reference.standing
    if known is not None and (known.photograph_count or known.contradiction_count):
        message.place.surveyed_share = 1.0 if known.surveyed_share is None else known.surveyed_share
        message.place.photograph_count = known.photograph_count
        message.place.contradiction_count = known.contradiction_count
        message.place.is_outdated = known.outdate_time_us is not None
    message.create_time.FromDatetime(reference.create_time)
    return message


_RETIRED_BECAUSE = {
    RetirementReason.CONTRADICTED: "photographs from about its viewpoint do not show what it shows",
    RetirementReason.SURVEY_OUTDATED: "photographs of its place show too little of what was surveyed: survey it again",
    RetirementReason.VOUCHERS_GONE: "the surveyed references that its pose rests on are not in the scene: "
    "they were deleted or retired, or never stored",
    RetirementReason.PLACE_FULL: "its place has as many adopted references as it may, which are more useful",
    RetirementReason.BY_OPERATOR: "by request of a caller who may change the scene",
}


def retirement_of(retired: Retirement) -> str:
    """One sentence for a person about why a reference is retired."""
    return f"retired on {retired.time:%Y-%m-%d %H:%M} UTC: {_RETIRED_BECAUSE[retired.reason]}"


CLOCKS_DIFFER = timedelta(minutes=1)
"""Clocks of servers and of those who import may differ by so much."""
MOST_NAMED = 10
"""Places that one warning names."""


def named_place(reference_id: str, record: ReferenceRecord | None) -> str:
    """A place by its surveyed reference, and where that is; without the record by its id alone."""
    if record is None:
        return reference_id
    x, y, z = record.world_from_camera.translation.tolist()
    return f"{reference_id} at ({x:.2f}, {y:.2f}, {z:.2f})"


def outdated_places(places: Sequence[str]) -> str:
    """One sentence for a person that says which places, each a `named_place`, need a new survey."""
    more = len(places) - MOST_NAMED
    named = ", ".join(places[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
    return (
        f"photographs around {named} show too little of what was surveyed, so that what was adopted there is retired: "
        "survey these places again"
    )


def kept_adopted(hours: float) -> str:
    """One sentence for a person that says how long adopted photographs are kept."""
    days = f" ({hours / 24:g} days)" if hours > 48 else ""
    return (
        f"what it adopts is deleted {hours:g} h{days} after it was adopted, as captured calls are: see the server's "
        "--capture-hours"
    )


def new_provenance(reference: pb.Reference, field: str, adopted_hours: float) -> Provenance:
    """How the pose of a reference to be created is known; FieldError names what is wrong.

    Adopted references are kept for `adopted_hours`; one that is older, or of a time to come, is refused.
    """
    if not reference.HasField("provenance"):
        return GIVEN_POSE
    message, path = reference.provenance, joined(field, "provenance")
    sources: wire.ProtoEnum = pb.PoseSource
    if message.source not in sources.values():
        raise FieldError(joined(path, "source"), f"must be one of PoseSource's values, is {message.source}")
    if message.HasField("adopt_time"):
        check_time(message.adopt_time, joined(path, "adopt_time"))
    found = provenance_from_message(message, path)
    if found.adopt_time is not None:
        age = datetime.now(timezone.utc) - found.adopt_time
        if not -CLOCKS_DIFFER <= age <= timedelta(hours=adopted_hours):
            fault = (
                "is to come" if age < timedelta() else f"is more than {adopted_hours:g} h ago: older ones are deleted"
            )
            raise FieldError(joined(path, "adopt_time"), f"{found.adopt_time:%Y-%m-%d %H:%M} UTC {fault}")
    return found if message.source else replace(found, source=GIVEN)


def restored_from_message(request: pb.RestoreReferencesRequest, scene_id: str) -> tuple[datetime | None, str]:
    """Since when, and of which reference's place, retired ones are restored; FieldError names a wrong field."""
    since = None
    if request.HasField("since"):
        check_time(request.since, "since")
        since = request.since.ToDatetime(timezone.utc)
    if not request.place:
        return since, ""
    its_scene_id, reference_id = wire.reference_ids_from_name(request.place, "place")
    if its_scene_id != scene_id:
        raise FieldError("place", f"{names.shown(request.place)} is a reference of another scene than {scene_id!r}")
    return since, reference_id


def restored_to_message(
    scene_id: str, reference_ids: Sequence[str], staying: Mapping[str, str]
) -> pb.RestoreReferencesResponse:
    """Message of the ids of references that are chosen again, and why others stay retired, by id."""
    still = [pb.StillRetired(name=names.reference_name(scene_id, it), reason=why) for it, why in staying.items()]
    made = [names.reference_name(scene_id, it) for it in reference_ids]
    return pb.RestoreReferencesResponse(references=made, still_retired=still)


MUCH_IGNORED = 0.8
"""A mask that ignores a larger share of a reference is most likely inverted."""


def nearly_ignored(shares: Mapping[str, float]) -> list[str]:
    """Warning about new references whose masks ignore nearly everything, from the share that each ignores; or none."""
    much = {reference_id: share for reference_id, share in shares.items() if share > MUCH_IGNORED}
    if not much:
        return []
    first, share = next(iter(much.items()))
    others = f", and those of {len(much) - 1} more ignore as much" if len(much) > 1 else ""
    return [
        f"the mask of reference {first!r} ignores {100 * share:.0f} % of its image{others}: 0 means ignore, every "
        "other value use; is it inverted?"
    ]


def implausible_depths(medians: Mapping[str, float | None]) -> list[str]:
    """Warning about new references whose median depth is that of another unit; or none."""
    texts = {name: "" if depth is None else implausible_median(depth) for name, depth in medians.items()}
    wrong = {name: text for name, text in texts.items() if text}
    if not wrong:
        return []
    first, text = next(iter(wrong.items()))
    others = f", and those of {len(wrong) - 1} more are as far" if len(wrong) > 1 else ""
    return [
        f"the median depth of reference {first!r} is {text}{others}, so it is not used: is unit_m right, "
        "0.001 for millimetres?"
    ]


def choice_to_message(choice: Choice, scene_id: str) -> pb.RetrieveReferencesResponse:
    """Message of chosen references."""
    message = pb.RetrieveReferencesResponse(retrieval=choice.descriptor, store_generation=choice.generation)
    for chosen in choice.references:
        message.references.add(
            name=names.reference_name(scene_id, chosen.reference_id),
            similarity=chosen.similarity,
            world_from_camera=wire.transform_to_message(chosen.world_from_camera),
        )
    return message


def audit_to_message(audit: ReferenceAudit) -> pb.ReferenceAudit:
    """Message of an audit; unknown values become 0."""
    known = provenance_to_message(audit.provenance)
    return message_of(
        audit, pb.ReferenceAudit, name=audit.reference, reprojection_error_px=audit.error_px, provenance=known
    )


def retired_to_message(reference: str, retired: Retirement) -> pb.ReferenceAudit:
    """Message of the audit of a retired reference, which is compared with none, by its name."""
    return pb.ReferenceAudit(name=reference, verdict=pb.AUDIT_VERDICT_RETIRED, message=retirement_of(retired))


def scene_to_message(scene: SceneRecord) -> pb.Scene:
    """Message of a scene."""
    known = scene.attributes
    message = pb.Scene(
        name=names.scene_name(scene.scene_id),
        generation=scene.generation,
        reference_count=scene.reference_count,
        datum=datum_to_message(known.datum) if known.datum else None,
        down_in_world=wire.vector_to_message(known.down_in_world) if known.down_in_world else None,
        calibration=calibration_to_message(known.calibration) if known.calibration else None,
        arbitrary_unit=known.arbitrary_unit,
        labels=scene.labels,
        adoption=adoption_to_message(known.adoption) if known.adoption else None,
    )
    message.create_time.FromDatetime(scene.create_time)
    return message


def attributes_from_message(request: pb.CreateSceneRequest) -> SceneAttributes:
    """Reads the attributes of a scene to be created; FieldError names a wrong field."""
    try:
        return SceneAttributes(
            datum_from_message(request.datum, "datum") if request.HasField("datum") else None,
            direction_from_message(request.down_in_world, "down_in_world")
            if request.HasField("down_in_world")
            else None,
            arbitrary_unit=request.arbitrary_unit,
            adoption=adoption_from_message(request.adoption, "adoption") if request.HasField("adoption") else None,
        )
    except ContradictingDown as error:
        raise FieldError("down_in_world", str(error)) from None
    except DatumWithoutMetres as error:
        raise FieldError("datum", str(error)) from None
    except WrongRadius as error:
        raise FieldError("adoption.max_radius_m", str(error)) from None


def labels_from_message(labels: Mapping[str, str], field: str) -> dict[str, str]:
    """Reads the labels of a scene, or those that scenes shall have; FieldError names a wrong one."""
    try:
        return check_labels(labels)
    except ValueError as error:
        raise FieldError(field, str(error)) from None


def changes_from_message(request: pb.UpdateSceneRequest) -> dict[str, Any]:
    """Reads the arguments of `Store.update_scene`: the fields in a request's mask, None for those that its scene lacks.

    FieldError if the mask is empty or names a field that cannot be changed, or a value is wrong.
    """
    paths = list(dict.fromkeys(request.update_mask.paths))
    if not paths:
        raise FieldError("update_mask", f"must name what to change: {', '.join(_READERS)}")
    for path in paths:
        if path not in _READERS:
            raise FieldError("update_mask", f"must name only {', '.join(_READERS)}, names {names.shown(path)}")
    scene = request.scene
    return {path: _READERS[path](scene, path) for path in paths}


def _optional(read: Callable[[Any, str], object]) -> Callable[[pb.Scene, str], object]:
    """Makes a reader of a scene's field that may be absent."""
    return lambda scene, path: read(getattr(scene, path), joined("scene", path)) if scene.HasField(path) else None


def _measured(message: pb.SceneCalibration, field: str) -> Calibration:
    """Reads a calibration with its conditions; the server sets its time itself."""
    variants: wire.ProtoEnum = localization_pb.Variant
    if message.variant not in variants.values()[1:]:
        raise FieldError(joined(field, "variant"), f"must be one of Variant's values, is {message.variant}")
    measured = pb.SceneCalibration()
    measured.CopyFrom(message)
    measured.ClearField("create_time")  # ignored, so that it may be anything
    return calibration_from_message(measured, field)


_READERS: dict[str, Callable[[pb.Scene, str], object]] = {
    "datum": _optional(datum_from_message),
    "down_in_world": _optional(direction_from_message),
    "calibration": _optional(_measured),
    "arbitrary_unit": lambda scene, path: scene.arbitrary_unit,
    "adoption": _optional(adoption_from_message),
    "labels": lambda scene, path: labels_from_message(scene.labels, joined("scene", path)),
}
