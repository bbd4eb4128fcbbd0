"""New references: they are read, described, compared with their scene and stored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

from mapless import wire
from mapless.geometry import MAX_COORDINATE_M, RigidTransform
from mapless.provenance import Provenance
from mapless.v1 import reference_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.query import Photo
from mapless_server.errors import DataLoss, NotFound
from mapless_server.rpc import Call
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, ReferenceRecord, SceneRecord, Store

from .messages.queries import photo_from_message, with_depth
from .messages.references import implausible_depths, nearly_ignored, new_provenance

if TYPE_CHECKING:  # services do not load what computes
    from mapless_server.engine.queue_engine import QueueEngine
    from mapless_server.scenes.agreement import Agreement

MAX_NOTED = 10  # names in a line of the log
MAX_COMPARED_ADDED = 100  # stored ones that new ones are compared with: 1 ms, where adding takes hundreds

T = TypeVar("T")


class RunStored(Protocol):
    """Runs an operation of the store in a thread."""

    async def __call__(self, operation: Callable[..., T], *arguments: object) -> T:
        """The operation's result."""


class Draft(NamedTuple):
    """A reference to be described and stored."""

    reference_id: str
    photo: Photo
    world_from_camera: RigidTransform
    provenance: Provenance


class Adding:
    """Adds references to scenes."""

    def __init__(
        self, engine: Callable[[], QueueEngine], store: Store, stored: RunStored, adopted_hours: float
    ) -> None:
        """See `ReferenceService`; `stored` runs what reads or writes the store."""
        self._engine = engine
        self._store = store
        self._stored = stored
        self._adopted_hours = adopted_hours

    def draft(self, request: pb.CreateReferenceRequest, path: str) -> Draft:
        """Reads a reference and checks all but its pixels; FieldError or InvalidArgument names the wrong field."""
        reference_id = wire.checked_id(request.reference_id, wire.joined(path, "reference_id"))
        path = wire.joined(path, "reference")
        if not request.HasField("reference"):
            raise FieldError(path, "is required")
        reference = request.reference
        if not reference.HasField("world_from_camera"):
            raise FieldError(f"{path}.world_from_camera", "is required")
        world_from_camera = wire.transform_from_message(
            reference.world_from_camera, f"{path}.world_from_camera", MAX_COORDINATE_M
        )
        limits = self._engine().options.image_limits
        photo = with_depth(photo_from_message(reference, path, limits), reference, path, limits)
        return Draft(reference_id, photo, world_from_camera, new_provenance(reference, path, self._adopted_hours))

    async def add(
        self, scene_key: SceneKey, drafts: Sequence[Draft], call: Call
    ) -> tuple[Sequence[ReferenceRecord], list[str]]:
        """Stores references; returns their records, and contradictions of the scene's attributes."""
        # Describing takes long, so an unknown scene is rejected before. The store checks again when it adds.
        added = [it.world_from_camera for it in drafts]
        warnings = await self._stored(self._contradictions_of_added, scene_key, added, call)
        call.note(scene=scene_key, references=len(drafts))
        described = await self._engine().describe([it.photo for it in drafts], call.caller)
        references = [
            NewReference(
                it.reference_id,
                it.photo.image,
                it.photo.camera,
                it.world_from_camera,
                found.views,
                found.descriptors,
                it.photo.mask,
                it.provenance,
                it.photo.depth,
            )
            for it, found in zip(drafts, described, strict=True)
        ]
        warnings += await self._stored(self._repeats, scene_key, drafts, call)
        records = await self._stored(self._store.add_references, scene_key, references)
        if blank := [record.reference_id for record in records if not record.feature_count]:
            call.note(references_without_features=blank[:MAX_NOTED])
        agreements = self._engine().references.agreements
        agreements.changed(scene_key)
        warnings += await self._stored(self._said_of, scene_key, agreements.known(scene_key))
        shares = {it.reference_id: found.ignored_share for it, found in zip(records, described, strict=True)}
        depths = {it.reference_id: found.median_depth for it, found in zip(records, described, strict=True)}
        implausible = implausible_depths(depths)
        if implausible and not await self._stored(self._is_arbitrary, scene_key):
            warnings += implausible
        return records, [*warnings, *nearly_ignored(shares)]

    def _said_of(self, scene_key: SceneKey, agreement: Agreement) -> list[str]:
        """Returns what is said of a scene's agreement; nothing of a unit that cannot be read."""
        return agreement.warnings(arbitrary_unit=False) and agreement.warnings(self._is_arbitrary(scene_key))

    def _is_arbitrary(self, scene_key: SceneKey) -> bool:
        """Whether a scene's unit is arbitrary; one that cannot be read may be."""
        try:
            return self._store.get_attributes(scene_key).arbitrary_unit
        except (DataLoss, NotFound):
            return True

    def _repeats(self, scene_key: SceneKey, drafts: Sequence[Draft], call: Call) -> list[str]:
        """Returns and logs which poses or photographs the references to be added repeat."""
        from mapless_server.scenes.repeats import PosedImage, repeats  # services do not load what computes

        added = [PosedImage.of(it.reference_id, it.photo.image, it.world_from_camera) for it in drafts]
        posed = [(it.photo.camera, it.world_from_camera) for it in drafts]
        try:
            stored = self._store.list_alike(scene_key, {it.image_sha256 for it in added}, posed)
        except DataLoss as error:
            return [f"the references were not compared with the scene's: {error}"]
        found = repeats(added, stored)
        if found:
            call.note(repeats=found)
        return found

    def _contradictions_of_added(self, scene_key: SceneKey, added: Sequence[RigidTransform], call: Call) -> list[str]:
        try:
            scene = self._store.get_scene(scene_key)
        except DataLoss as error:
            return [f"the references were not compared with the scene: {error}"]
        return contradictions(self._store, scene, MAX_COMPARED_ADDED, call, added)


def contradictions(
    store: Store, scene: SceneRecord, count: int, call: Call, added: Sequence[RigidTransform] = ()
) -> list[str]:
    """Returns and logs contradictions of the scene's attributes and poses of its first and of added references."""
    from mapless_server.scenes import plausibility  # services do not load what computes

    try:
        references = store.list_references(scene.scene_key, count, "")
    except DataLoss as error:
        return [f"the scene was not compared with its references: {error}"]
    poses = [it.world_from_camera for it in references]
    found = plausibility.contradictions(poses, scene.attributes, added)
    if found:
        call.note(contradictions=found)
    return found
