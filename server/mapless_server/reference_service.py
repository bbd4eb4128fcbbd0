"""ReferenceService: scenes and references as resources; images are described before the store is touched."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import asyncio
import base64
import binascii
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from mapless import names, wire
from mapless.geometry import RigidTransform
from mapless.v1 import reference_service_pb2 as pb
from mapless.v1 import reference_service_pb2_grpc as rpcs
from mapless.wire import FieldError

from .engine import Engine
from .errors import AlreadyExists
from .photos import photo_from_message
from .query import Photo
from .rpc import Call
from .store import NewReference, ReferenceRecord, SceneRecord, Store
from .tenancy import SceneKey, key_of

DEFAULT_PAGE_SIZE = 100
MAX_PAGE_SIZE = 1000
MAX_BATCH = 1000
STORE_THREADS = 4  # writers queue for one lock anyhow; these keep readers from waiting behind them

T = TypeVar("T")
Record = TypeVar("Record")
M = TypeVar("M", pb.Scene, pb.Reference)
Draft = tuple[str, Photo, RigidTransform]
"""Reference id, photograph and world_from_camera."""
PageRequest = pb.ListScenesRequest | pb.ListReferencesRequest


class ReferenceService(rpcs.ReferenceServiceServicer):
    """Keeps scenes and their references."""

    def __init__(self, engine: Callable[[], Engine], store: Store) -> None:
        """`engine` gives it, or raises Unavailable as long as there is none."""
        self._engine = engine
        self._store = store
        self._threads = ThreadPoolExecutor(STORE_THREADS, thread_name_prefix="store")

    def close(self) -> None:
        """Waits for what the store is doing."""
        self._threads.shutdown(wait=True)

    async def CreateScene(self, request: pb.CreateSceneRequest, call: Call) -> pb.CreateSceneResponse:
        """Implements ReferenceService.CreateScene."""
        scene_id = wire.checked_id(request.scene_id, "scene_id")
        scene = await self._stored(self._store.create_scene, key_of(call.principal.tenant, scene_id))
        return pb.CreateSceneResponse(scene=_scene_to_message(scene))

    async def GetScene(self, request: pb.GetSceneRequest, call: Call) -> pb.GetSceneResponse:
        """Implements ReferenceService.GetScene."""
        scene = await self._stored(self._store.get_scene, _scene_key(request.name, "name", call))
        return pb.GetSceneResponse(scene=_scene_to_message(scene))

    async def ListScenes(self, request: pb.ListScenesRequest, call: Call) -> pb.ListScenesResponse:
        """Implements ReferenceService.ListScenes."""
        tenant = call.principal.tenant
        page = Page(request, tenant, "scenes")
        found = await self._stored(self._store.list_scenes, tenant, page.limit, page.after)
        scenes, token = page.cut(found, lambda scene: scene.scene_id)
        return pb.ListScenesResponse(scenes=await _many(_scene_to_message, scenes), next_page_token=token)

    async def DeleteScene(self, request: pb.DeleteSceneRequest, call: Call) -> pb.DeleteSceneResponse:
        """Implements ReferenceService.DeleteScene."""
        await self._stored(self._store.delete_scene, _scene_key(request.name, "name", call))
        return pb.DeleteSceneResponse()

    async def CreateReference(self, request: pb.CreateReferenceRequest, call: Call) -> pb.CreateReferenceResponse:
        """Implements ReferenceService.CreateReference."""
        scene_key = _scene_key(request.scene, "scene", call)
        draft = self._draft(request, "")
        try:
            (record,) = await self._add(scene_key, [draft], call)
        except AlreadyExists as error:
            raise AlreadyExists(str(error), field="reference_id") from error
        return pb.CreateReferenceResponse(reference=_reference_to_message(record))

    async def BatchCreateReferences(
        self, request: pb.BatchCreateReferencesRequest, call: Call
    ) -> pb.BatchCreateReferencesResponse:
        """Implements ReferenceService.BatchCreateReferences."""
        scene_key = _scene_key(request.scene, "scene", call)
        if not 1 <= len(request.requests) <= MAX_BATCH:
            raise FieldError("requests", f"must be 1 to {MAX_BATCH}, are {len(request.requests)}")
        seen: set[str] = set()
        for i, item in enumerate(request.requests):
            if item.scene not in ("", request.scene):
                raise FieldError(f"requests[{i}].scene", f"must be empty or {request.scene!r}")
            if item.reference_id in seen:
                raise FieldError(f"requests[{i}].reference_id", f"{names.shown(item.reference_id)} stands twice")
            seen.add(item.reference_id)
        # Every look at a photograph copies it: too much for the event loop.
        drafts = await asyncio.to_thread(
            lambda: [self._draft(item, f"requests[{i}]") for i, item in enumerate(request.requests)]
        )
        records = await self._add(scene_key, drafts, call)
        return pb.BatchCreateReferencesResponse(references=await _many(_reference_to_message, records))

    async def GetReference(self, request: pb.GetReferenceRequest, call: Call) -> pb.GetReferenceResponse:
        """Implements ReferenceService.GetReference."""
        key, reference_id = _reference_key(request.name, "name", call)
        message = _reference_to_message(await self._stored(self._store.get_reference, key, reference_id))
        if request.include_image:
            message.image = await self._stored(self._store.read_image, key, reference_id)
        return pb.GetReferenceResponse(reference=message)

    async def ListReferences(self, request: pb.ListReferencesRequest, call: Call) -> pb.ListReferencesResponse:
        """Implements ReferenceService.ListReferences."""
        scene_key = _scene_key(request.scene, "scene", call)
        page = Page(request, call.principal.tenant, request.scene)
        found = await self._stored(self._store.list_references, scene_key, page.limit, page.after)
        references, token = page.cut(found, lambda reference: reference.reference_id)
        messages = await _many(_reference_to_message, references)
        return pb.ListReferencesResponse(references=messages, next_page_token=token)

    async def DeleteReference(self, request: pb.DeleteReferenceRequest, call: Call) -> pb.DeleteReferenceResponse:
        """Implements ReferenceService.DeleteReference."""
        await self._stored(self._store.delete_reference, *_reference_key(request.name, "name", call))
        return pb.DeleteReferenceResponse()

    def _draft(self, request: pb.CreateReferenceRequest, path: str) -> Draft:
        """What a request asks to store, all checked but the pixels; FieldError or InvalidArgument names the field."""
        reference_id = wire.checked_id(request.reference_id, wire.joined(path, "reference_id"))
        path = wire.joined(path, "reference")
        if not request.HasField("reference"):
            raise FieldError(path, "is required")
        reference = request.reference
        if not reference.HasField("world_from_camera"):
            raise FieldError(f"{path}.world_from_camera", "is required")
        world_from_camera = wire.transform_from_message(
            reference.world_from_camera, f"{path}.world_from_camera", wire.MAX_COORDINATE_M
        )
        photo = photo_from_message(reference, path, self._engine().options.image_limits)
        return reference_id, photo, world_from_camera

    async def _add(self, scene_key: SceneKey, drafts: Sequence[Draft], call: Call) -> Sequence[ReferenceRecord]:
        # Describing takes long: an unknown scene is worth noticing before. The store looks again when it adds.
        await self._stored(self._store.get_scene, scene_key)
        described = await self._engine().describe([photo for _, photo, _ in drafts], call.caller)
        references = [
            NewReference(reference_id, photo.image, photo.camera, world_from_camera, views)
            for (reference_id, photo, world_from_camera), views in zip(drafts, described, strict=True)
        ]
        return await self._stored(self._store.add_references, scene_key, references)

    async def _stored(self, operation: Callable[..., T], *arguments: object) -> T:
        """An operation of the store, off the event loop; Unavailable while the server starts."""
        self._engine()
        return await asyncio.get_running_loop().run_in_executor(self._threads, operation, *arguments)


class Page:
    """One page of a list: how much to ask the store for, where to begin, where the next page begins.

    A token is the tenant, the collection and the last id of the page before: opaque to callers, and good for its own
    list only.

    Raises:
        FieldError: a negative page size, or a token that this list did not give.
    """

    def __init__(self, request: PageRequest, tenant: str, collection: str) -> None:
        if request.page_size < 0:
            raise FieldError("page_size", f"must not be negative, is {request.page_size}")
        self._size = min(request.page_size or DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE)
        self._list = f"{tenant}\n{collection}"
        self.limit = self._size + 1  # one more tells whether there is a next page
        self.after = self._read_token(request.page_token) if request.page_token else ""

    def cut(self, records: Sequence[Record], id_of: Callable[[Record], str]) -> tuple[Sequence[Record], str]:
        """The records of this page, and the token of the next one."""
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
        raise FieldError("page_token", "is not one that this list gave")


def _scene_key(name: str, field: str, call: Call) -> SceneKey:
    """The key of the caller's scene of this name; FieldError if it is none."""
    return key_of(call.principal.tenant, wire.scene_id_from_name(name, field))


def _reference_key(name: str, field: str, call: Call) -> tuple[SceneKey, str]:
    """The key of the caller's scene, and the reference's id within it; FieldError if the name is none."""
    scene_id, reference_id = wire.reference_ids_from_name(name, field)
    return key_of(call.principal.tenant, scene_id), reference_id


async def _many(to_message: Callable[[Record], M], records: Sequence[Record]) -> list[M]:
    """The messages of a page; a thousand take tens of milliseconds, too long for the event loop."""
    return await asyncio.to_thread(lambda: [to_message(record) for record in records])


def _scene_to_message(scene: SceneRecord) -> pb.Scene:
    message = pb.Scene(
        name=names.scene_name(scene.scene_id), generation=scene.generation, reference_count=scene.reference_count
    )
    message.create_time.FromDatetime(scene.create_time)
    return message


def _reference_to_message(reference: ReferenceRecord) -> pb.Reference:
    message = pb.Reference(
        name=names.reference_name(reference.scene_id, reference.reference_id),
        intrinsics=wire.camera_to_message(reference.camera),
        world_from_camera=wire.transform_to_message(reference.world_from_camera),
        image_sha256=reference.image_sha256,
        feature_count=reference.feature_count,
    )
    message.create_time.FromDatetime(reference.create_time)
    return message
