"""ReferenceService: scenes and references as resources; images are described before they are stored."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from mapless import names, wire
from mapless.depth import depth_to_message
from mapless.geometry import MAX_COORDINATE_M
from mapless.v1 import reference_service_pb2 as pb
from mapless.v1 import reference_service_pb2_grpc as rpcs
from mapless.wire import FieldError
from mapless_server.engine.failures import SceneMadeAnew
from mapless_server.engine.query import DEFAULT_REFERENCE_COUNT
from mapless_server.errors import AlreadyExists
from mapless_server.rpc import Call
from mapless_server.scenes import Viewpoint
from mapless_server.security import NOWHERE, SceneKey, key_of, scene_id_of, tenant_of
from mapless_server.store import ContradictingDown, DatumWithoutMetres, SceneAttributes, Store, WrongRadius

from .adding import Adding, contradictions
from .messages.enums import message_of
from .messages.priors import priors_from_message
from .messages.queries import photo_from_message, reference_ids_from_names
from .messages.references import (
    MOST_NAMED,
    Page,
    Record,
    attributes_from_message,
    audit_to_message,
    changes_from_message,
    choice_to_message,
    kept_adopted,
    labels_from_message,
    named_place,
    outdated_places,
    reference_to_message,
    restored_from_message,
    restored_to_message,
    retired_to_message,
    scene_to_message,
)
from .reach import Reach, check_stays_in_reach
from .reports import scene_report

if TYPE_CHECKING:  # services do not load what computes
    from mapless_server.engine.queue_engine import QueueEngine
    from mapless_server.scenes import ReferenceAudit
    from mapless_server.scenes.agreement import Agreement

MAX_BATCH = 1000
MAX_RETRIEVED = 1000
DEFAULT_AUDITS, MAX_AUDITS = 10, 100
MAX_COMPARED = 1000  # references, the first by id, with which a change of the scene is compared
STORE_THREADS = 4  # writers share one lock; the other threads keep readers from waiting for it

T = TypeVar("T")
M = TypeVar("M", pb.Scene, pb.Reference)


class ReferenceService(rpcs.ReferenceServiceServicer):
    """Stores scenes and their references."""

    def __init__(self, engine: Callable[[], QueueEngine], store: Store, adopted_hours: float = 24.0) -> None:
        """`engine` returns the engine; it raises Unavailable while the server starts.

        Adopted references are deleted when they are `adopted_hours` old, which `UpdateScene` says.
        """
        self._adopted_hours = adopted_hours
        self._engine = engine
        self._store = store
        self._reach = Reach(store)
        self._adding = Adding(engine, store, self._stored, adopted_hours)
        self._threads = ThreadPoolExecutor(STORE_THREADS, thread_name_prefix="store")
        # A report of a large scene takes seconds: one at a time, and none keeps another call from the store.
        self._reporting = ThreadPoolExecutor(1, thread_name_prefix="report")

    def close(self) -> None:
        """Waits for running operations of the store."""
        for threads in (self._threads, self._reporting):
            threads.shutdown(wait=True)

    async def CreateScene(self, request: pb.CreateSceneRequest, call: Call) -> pb.CreateSceneResponse:
        """Implements ReferenceService.CreateScene."""
        scene_id = wire.checked_id(request.scene_id, "scene_id")
        key, attributes = key_of(call.principal.tenant, scene_id), attributes_from_message(request)
        labels = labels_from_message(request.labels, "labels")
        check_stays_in_reach(call, scene_id, labels, "scene_id")
        scene = await self._stored(self._store.create_scene, key, attributes, labels)
        warnings = [] if scene.attributes.adoption is None else [kept_adopted(self._adopted_hours)]
        return pb.CreateSceneResponse(scene=scene_to_message(scene), warnings=warnings)

    async def GetScene(self, request: pb.GetSceneRequest, call: Call) -> pb.GetSceneResponse:
        """Implements ReferenceService.GetScene."""
        from mapless_server.store import counts

        key = await self._reach.scene_key(call, request.name, "name")
        scene = await self._stored(self._store.get_scene, key)
        agreement = await self._agreement(key)
        pending = await self._stored(self._engine().references.pending, key)
        warnings = dict.fromkeys(agreement.warnings(scene.attributes.arbitrary_unit))
        if not agreement.contradicts_itself:  # else what its references say of lenses is of no use
            warnings |= await self._stored(self._lens_warnings, key)
        if scene.attributes.adoption is not None:
            warnings[kept_adopted(self._adopted_hours)] = None
        warnings |= await self._stored(self._outdated_places, key)
        numbers = await self._stored(counts.count_references, self._store.database, key)
        return pb.GetSceneResponse(
            scene=scene_to_message(scene),
            warnings=warnings,
            contradiction=agreement.contradiction,
            compared_pair_count=agreement.pair_count,
            agreeing_pair_count=agreement.agreeing_count,
            pending_work=[
                pb.PendingWork(kind=it.work, name=it.name, reference_count=it.reference_count) for it in pending
            ],
            adopted_reference_count=numbers.adopted_count,
            retired_reference_count=numbers.retired_count,
        )

    async def _agreement(self, key: SceneKey) -> Agreement:
        """How a scene's references agree now; no thread of the store waits for what must be computed."""
        from mapless_server.scenes.scene_agreements import LONGEST_WAIT_S  # services do not load what computes

        agreements = self._engine().references.agreements
        if (update := agreements.touch(key)) is not None:
            await asyncio.wait([asyncio.wrap_future(update)], timeout=LONGEST_WAIT_S)
        return agreements.known(key)

    def _lens_warnings(self, key: SceneKey) -> dict[str, None]:
        known = self._store.get_attributes(key)
        # Older ones may be of a server that is gone, and of references that have been replaced.
        newest = max((it.generation for it in known.self_calibrations), default=0)
        return dict.fromkeys(it.lens for it in known.self_calibrations if it.lens and it.generation == newest)

    def _outdated_places(self, key: SceneKey) -> dict[str, None]:
        """Says which places of a scene need a new survey."""
        from mapless_server.store import adoption
        from mapless_server.store.reporting import find_references

        with self._store.database.read() as connection:
            outdated = adoption.list_outdated(connection, key)
            named = find_references(connection, key, list(outdated)[:MOST_NAMED])
        places = [named_place(name, named.get(it)) for it, name in outdated.items()]
        return dict.fromkeys([outdated_places(places)] if places else [])

    async def UpdateScene(self, request: pb.UpdateSceneRequest, call: Call) -> pb.UpdateSceneResponse:
        """Implements ReferenceService.UpdateScene."""
        key = await self._reach.scene_key(call, request.scene.name, "scene.name")
        changes, limit = changes_from_message(request), call.principal.limit
        if "labels" in changes and tenant_of(key) != NOWHERE:
            check_stays_in_reach(call, scene_id_of(key), changes["labels"], "scene.labels")
        try:
            scene = await self._stored(partial(self._store.update_scene, key, **changes, limit=limit))
        except ContradictingDown as error:
            field = "down_in_world" if changes.get("down_in_world") else "datum"
            raise FieldError(f"scene.{field}", str(error)) from None
        except DatumWithoutMetres as error:
            field = "datum" if changes.get("datum") else "arbitrary_unit"
            raise FieldError(f"scene.{field}", str(error)) from None
        except WrongRadius as error:
            raise FieldError("scene.adoption.max_radius_m", str(error)) from None
        warnings: list[str] = []
        if changes.keys() - {"calibration", "labels"}:
            warnings = await self._stored(contradictions, self._store, scene, MAX_COMPARED, call)
        if changes.get("adoption") is not None:
            warnings.append(kept_adopted(self._adopted_hours))
        return pb.UpdateSceneResponse(scene=scene_to_message(scene), warnings=warnings)

    async def ListScenes(self, request: pb.ListScenesRequest, call: Call) -> pb.ListScenesResponse:
        """Implements ReferenceService.ListScenes."""
        tenant, limit = call.principal.tenant, call.principal.limit
        labels = labels_from_message(request.labels, "labels")
        page = Page(request, tenant, f"scenes {sorted(labels.items())}" if labels else "scenes")
        found = await self._stored(self._store.list_scenes, tenant, page.limit, page.after, labels, limit)
        scenes, token = page.cut(found, lambda scene: scene.scene_id)
        return pb.ListScenesResponse(scenes=await _many(scene_to_message, scenes), next_page_token=token)

    async def DeleteScene(self, request: pb.DeleteSceneRequest, call: Call) -> pb.DeleteSceneResponse:
        """Implements ReferenceService.DeleteScene."""
        scene_key = await self._reach.scene_key(call, request.name, "name")
        await self._stored(self._delete_scene, self._engine(), scene_key)
        return pb.DeleteSceneResponse()

    def _delete_scene(self, engine: QueueEngine, scene_key: SceneKey) -> None:
        # The scene may be deleted although this fails late, or although the call has ended.
        try:
            engine.forget_references(self._store.delete_scene(scene_key))
        finally:
            engine.forget_scene(scene_key)

    async def CreateReference(self, request: pb.CreateReferenceRequest, call: Call) -> pb.CreateReferenceResponse:
        """Implements ReferenceService.CreateReference."""
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        draft = self._adding.draft(request, "")
        try:
            (record,), warnings = await self._adding.add(scene_key, [draft], call)
        except AlreadyExists as error:
            raise AlreadyExists(str(error), field="reference_id", resource=error.resource) from error
        return pb.CreateReferenceResponse(reference=reference_to_message(record), warnings=warnings)

    async def BatchCreateReferences(
        self, request: pb.BatchCreateReferencesRequest, call: Call
    ) -> pb.BatchCreateReferencesResponse:
        """Implements ReferenceService.BatchCreateReferences."""
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        if not 1 <= len(request.requests) <= MAX_BATCH:
            raise FieldError("requests", f"must be 1 to {MAX_BATCH}, are {len(request.requests)}")
        seen: set[str] = set()
        for i, item in enumerate(request.requests):
            if item.scene not in ("", request.scene):
                raise FieldError(f"requests[{i}].scene", f"must be empty or {request.scene!r}")
            if item.reference_id in seen:
                raise FieldError(f"requests[{i}].reference_id", f"{names.shown(item.reference_id)} is repeated")
            seen.add(item.reference_id)
        # Each access to a photograph copies it, which takes too long for the event loop.
        drafts = await asyncio.to_thread(
            lambda: [self._adding.draft(item, f"requests[{i}]") for i, item in enumerate(request.requests)]
        )
        records, warnings = await self._adding.add(scene_key, drafts, call)
        messages = await _many(reference_to_message, records)
        return pb.BatchCreateReferencesResponse(references=messages, warnings=warnings)

    async def GetReference(self, request: pb.GetReferenceRequest, call: Call) -> pb.GetReferenceResponse:
        """Implements ReferenceService.GetReference."""
        key, reference_id = await self._reach.reference_key(call, request.name, "name")
        record = await self._stored(self._store.get_reference, key, reference_id)
        message = reference_to_message(record)
        if request.include_image:
            message.image = await self._stored(self._store.read_image_of, record.key)
            if record.mask_sha256:
                message.mask = await self._stored(self._store.read_mask_of, record.key)
            if record.depth_sha256:
                depth = await self._stored(self._store.read_depth_of, record.key)
                message.depth.CopyFrom(depth_to_message(depth))
        return pb.GetReferenceResponse(reference=message)

    async def ListReferences(self, request: pb.ListReferencesRequest, call: Call) -> pb.ListReferencesResponse:
        """Implements ReferenceService.ListReferences."""
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        only = {it: getattr(request, it) for it in ("only_adopted", "only_retired")}
        some = "".join(f" {name}" for name, is_wanted in only.items() if is_wanted)
        page = Page(request, call.principal.tenant, f"{request.scene}{some}")
        found = await self._stored(partial(self._store.list_references, scene_key, page.limit, page.after, **only))
        references, token = page.cut(found, lambda reference: reference.reference_id)
        messages = await _many(reference_to_message, references)
        return pb.ListReferencesResponse(references=messages, next_page_token=token)

    async def DeleteReference(self, request: pb.DeleteReferenceRequest, call: Call) -> pb.DeleteReferenceResponse:
        """Implements ReferenceService.DeleteReference."""
        named = await self._reach.reference_key(call, request.name, "name")
        await self._stored(self._delete_reference, self._engine(), *named)
        return pb.DeleteReferenceResponse()

    def _delete_reference(self, engine: QueueEngine, scene_key: SceneKey, reference_id: str) -> None:
        engine.forget_references({self._store.delete_reference(scene_key, reference_id)})

    async def RetireReference(self, request: pb.RetireReferenceRequest, call: Call) -> pb.RetireReferenceResponse:
        """Implements ReferenceService.RetireReference."""
        from mapless_server.store import adoption

        named = await self._reach.reference_key(call, request.name, "name")
        record = await self._stored(adoption.retire_by_operator, self._store, *named)
        return pb.RetireReferenceResponse(reference=reference_to_message(record))

    async def RestoreReferences(self, request: pb.RestoreReferencesRequest, call: Call) -> pb.RestoreReferencesResponse:
        """Implements ReferenceService.RestoreReferences."""
        from mapless_server.store import restoring

        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        since, place_id = restored_from_message(request, scene_id_of(scene_key))
        restored = await self._stored(restoring.restore, self._store, scene_key, since, place_id)
        return restored_to_message(scene_id_of(scene_key), restored.reference_ids, restored.staying)

    async def RestoreReference(self, request: pb.RestoreReferenceRequest, call: Call) -> pb.RestoreReferenceResponse:
        """Implements ReferenceService.RestoreReference."""
        from mapless_server.store import restoring

        named = await self._reach.reference_key(call, request.name, "name")
        record = await self._stored(restoring.restore_reference, self._store, *named)
        return pb.RestoreReferenceResponse(reference=reference_to_message(record))

    async def RetrieveReferences(
        self, request: pb.RetrieveReferencesRequest, call: Call
    ) -> pb.RetrieveReferencesResponse:
        """Implements ReferenceService.RetrieveReferences."""
        engine = self._engine()
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        if not 0 <= request.count <= MAX_RETRIEVED:
            raise FieldError("count", f"must be 0 to {MAX_RETRIEVED}, is {request.count}")
        narrowing, _ = priors_from_message(request, SceneAttributes())
        photo = photo_from_message(request, "", engine.options.image_limits)
        count = request.count or DEFAULT_REFERENCE_COUNT
        choice = await engine.retrieve(scene_key, photo, count, narrowing, call.caller)
        return await asyncio.to_thread(choice_to_message, choice, scene_id_of(scene_key))

    async def AuditScene(self, request: pb.AuditSceneRequest, call: Call) -> pb.AuditSceneResponse:
        """Implements ReferenceService.AuditScene."""
        engine = self._engine()
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        reference_ids, token = await self._audit_page(request, scene_key, call)
        generation = await self._stored(self._store.get_generation, scene_key)
        audits: list[ReferenceAudit] = []
        are_listed = not request.references
        retired = await self._stored(self._store.list_retirements, scene_key, reference_ids)
        if others := [it for it in reference_ids if it not in retired]:
            generation, audits = await engine.audit(scene_key, others, call.caller, are_listed)
        found = {it.name: it for it in map(audit_to_message, audits)}
        for reference_id, why in retired.items():
            name = names.reference_name(scene_id_of(scene_key), reference_id)
            found[name] = retired_to_message(name, why)
        in_order = [names.reference_name(scene_id_of(scene_key), it) for it in reference_ids]
        messages = [found[it] for it in in_order if it in found]
        return pb.AuditSceneResponse(audits=messages, next_page_token=token, store_generation=generation)

    async def _audit_page(
        self, request: pb.AuditSceneRequest, scene_key: SceneKey, call: Call
    ) -> tuple[Sequence[str], str]:
        """Returns the ids of the references to audit, and the token of the next page."""
        if request.references:
            return reference_ids_from_names(request.references, scene_id_of(scene_key), MAX_AUDITS), ""
        page = Page(request, call.principal.tenant, f"{request.scene} audit", DEFAULT_AUDITS, MAX_AUDITS)
        found = await self._stored(self._store.list_reference_ids, scene_key, page.limit, page.after)
        return page.cut(found, lambda reference_id: reference_id)

    async def GetSceneReport(self, request: pb.GetSceneReportRequest, call: Call) -> pb.GetSceneReportResponse:
        """Implements ReferenceService.GetSceneReport."""
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        loop = asyncio.get_running_loop()
        report = await loop.run_in_executor(self._reporting, scene_report, self._store, scene_key, request)
        return pb.GetSceneReportResponse(report=report)

    async def CheckCoverage(self, request: pb.CheckCoverageRequest, call: Call) -> pb.CheckCoverageResponse:
        """Implements ReferenceService.CheckCoverage."""
        engine = self._engine()
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        for field in ("world_from_camera", "intrinsics"):
            if not request.HasField(field):
                raise FieldError(field, "is required")
        pose = wire.transform_from_message(request.world_from_camera, "world_from_camera", MAX_COORDINATE_M)
        view = Viewpoint(wire.camera_from_message(request.intrinsics, "intrinsics"), pose)
        before = await self._stored(self._store.get_scene, scene_key)
        generation, coverage = await engine.check_coverage(scene_key, view, call.caller)
        scene = await self._stored(self._store.get_scene, scene_key)
        is_arbitrary = scene.attributes.arbitrary_unit
        if (scene.create_time, is_arbitrary) != (before.create_time, before.attributes.arbitrary_unit):
            raise SceneMadeAnew
        return message_of(coverage, pb.CheckCoverageResponse, store_generation=generation, arbitrary_unit=is_arbitrary)

    async def _stored(self, operation: Callable[..., T], *arguments: object) -> T:
        """Runs an operation of the store in a thread."""
        return await asyncio.get_running_loop().run_in_executor(self._threads, operation, *arguments)


async def _many(to_message: Callable[[Record], M], records: Sequence[Record]) -> list[M]:
    """Converts a page of records to messages in a thread; a thousand take tens of milliseconds."""
    return await asyncio.to_thread(lambda: [to_message(record) for record in records])
