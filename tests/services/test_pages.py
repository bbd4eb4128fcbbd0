"""Tokens of pages go on with the list that gave them, and with no other."""

import asyncio
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from google.protobuf.message import Message
from support.planted_engine import FEATURES
from support.servers import CAMERA, PHOTO, pose

from mapless.v1 import reference_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.method.features.views import View
from mapless_server.scenes.audit.verdict import AuditVerdict, ReferenceAudit
from mapless_server.security import Principal, key_of
from mapless_server.services.references import ReferenceService
from mapless_server.store import NewReference, Store

IDS = ["a", "b", "c"]
LISTS: dict[str, Message] = {
    "ListScenes": pb.ListScenesRequest(page_size=2),
    "ListReferences": pb.ListReferencesRequest(scene="scenes/a", page_size=2),
    "AuditScene": pb.AuditSceneRequest(scene="scenes/a", page_size=2),
}


@pytest.fixture
async def service(tmp_path: Path) -> AsyncIterator[ReferenceService]:
    """Over scenes a, b and c of two tenants, of which a has references a, b and c."""

    async def audit(_: Any, ids: Sequence[str], *__: Any) -> tuple[int, list[ReferenceAudit]]:
        return 1, [ReferenceAudit(f"scenes/a/references/{it}", AuditVerdict.SCENE_CHANGED, "") for it in ids]

    engine: Any = SimpleNamespace(audit=audit)
    with Store.open(tmp_path) as store:
        for tenant in ("acme", "other"):
            for scene_id in IDS:
                store.create_scene(key_of(tenant, scene_id))
            store.add_references(
                key_of(tenant, "a"),
                [NewReference(it, PHOTO, CAMERA, pose(0.0), {"sift": View(CAMERA, FEATURES)}) for it in IDS],
            )
        service = ReferenceService(lambda: engine, store)
        yield service
        await asyncio.to_thread(service.close)


async def page(service: ReferenceService, method: str, token: str = "", tenant: str = "acme") -> tuple[list[str], str]:
    """The ids on a page of a list, and the token of the next page."""
    request: Any = type(LISTS[method])()
    request.CopyFrom(LISTS[method])
    request.page_token = token
    call: Any = SimpleNamespace(principal=Principal(tenant), caller=None, note=lambda **_: None)
    answer = await getattr(service, method)(request, call)
    (items,) = (value for field, value in answer.ListFields() if field.message_type is not None)
    return [it.name.rpartition("/")[2] for it in items], answer.next_page_token


async def test_a_given_token_goes_on_with_its_list_alone(service: ReferenceService) -> None:
    given: dict[str, str] = {}
    for method in LISTS:
        ids, given[method] = await page(service, method)
        assert ids == IDS[:2]
    for giver, token in given.items():
        for method in LISTS:
            for tenant in ("acme", "other"):
                if (method, tenant) == (giver, "acme"):
                    assert await page(service, method, token) == (IDS[2:], "")
                    continue
                with pytest.raises(FieldError) as caught:
                    await page(service, method, token, tenant)
                assert caught.value.field == "page_token"
