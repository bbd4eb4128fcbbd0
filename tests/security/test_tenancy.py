"""A tenant sees nothing of the others: in no answer, list, error or cache."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.requests import REFERENCE_SERVICE, new_reference, requests_on

from mapless import wire
from mapless.v1 import reference_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.query import Description
from mapless_server.errors import NotFound, RequestError
from mapless_server.images import ImageLimits
from mapless_server.method.views import Features, View
from mapless_server.rpc import Call
from mapless_server.scenes import Choice, Coverage, CoverageVerdict
from mapless_server.security import (
    DEFAULT_TENANT,
    Principal,
    SceneKey,
    check_tenant,
    end_of_keys,
    key_of,
    scene_id_of,
    tenant_of,
)
from mapless_server.services.references import ReferenceService
from mapless_server.store import Store

# Names that a wrong comparison would confuse: by case, prefix, pattern, and order around "/".
TENANTS = [DEFAULT_TENANT, "acme", "ACME", "acme0", "acme-", "acm_", "a"]

ids = st.from_regex(r"\A[A-Za-z0-9_]([A-Za-z0-9_-]{0,6}[A-Za-z0-9_])?\Z")


class TestKeys:
    @given(first=st.tuples(ids | st.just(DEFAULT_TENANT), ids), second=st.tuples(ids | st.just(DEFAULT_TENANT), ids))
    def test_no_two_scenes_share_a_key(self, first: tuple[str, str], second: tuple[str, str]) -> None:
        assert (key_of(*first) == key_of(*second)) == (first == second)

    @given(tenant=ids | st.just(DEFAULT_TENANT), scene_id=ids)
    def test_a_key_gives_tenant_and_id_back(self, tenant: str, scene_id: str) -> None:
        key = key_of(check_tenant(tenant), wire.checked_id(scene_id, "scene_id"))
        assert (tenant_of(key), scene_id_of(key)) == (tenant, scene_id)

    @given(ids)
    def test_keys_of_the_default_tenant_are_the_ids(self, scene_id: str) -> None:
        assert key_of(DEFAULT_TENANT, scene_id) == scene_id

    @given(tenant=ids, other=ids, scene_id=ids)
    def test_a_tenants_range_of_keys_has_no_other_tenants(self, tenant: str, other: str, scene_id: str) -> None:
        key = key_of(other, scene_id)
        assert (key_of(tenant, "") < key < end_of_keys(tenant)) == (other == tenant) or tenant == DEFAULT_TENANT

    @pytest.mark.parametrize("name", ["", "a/b", "a b", ".", "a" * 129, "a\n", "ä"])
    def test_a_tenant_that_is_no_id_is_rejected(self, name: str) -> None:
        with pytest.raises(ValueError, match="an id is"):
            check_tenant(name)


@dataclass
class StandInEngine:
    """Finds one feature in every photograph."""

    store: Store
    options: Any = field(default_factory=lambda: SimpleNamespace(image_limits=ImageLimits()))

    def forget_scene(self, _: SceneKey) -> None:
        pass

    def forget_references(self, _: Collection[str]) -> None:
        pass

    async def describe(self, photos: Sequence[Any], *_: Any, **__: Any) -> list[Description]:
        features = Features(np.zeros((1, 2), np.float32), np.ones((1, 4), np.float32), np.ones(1, np.float32))
        return [Description({"stand-in": View(photo.camera.pinhole(), features)}, {}) for photo in photos]

    async def retrieve(self, scene_key: SceneKey, *_: Any) -> Choice:
        self.store.get_scene(scene_key)
        return Choice((), "stand-in", 1)

    def contradictions(self, poses: Sequence[Any], _: Any, added: Sequence[Any] = ()) -> list[str]:
        return [f"{len(poses)} references, of this tenant alone, and {len(added)} added"]

    async def audit(self, scene_key: SceneKey, reference_ids: Sequence[str], _: Any) -> Any:
        return self.store.get_scene(scene_key).generation, []

    async def check_coverage(self, scene_key: SceneKey, *_: Any) -> Any:
        nowhere = Coverage(CoverageVerdict.NOT_LOCALIZABLE, "nothing is looked at", 0, 0.0, None, ())
        return self.store.get_scene(scene_key).generation, nowhere


@dataclass
class Server:
    """The service on a store, called as by the guard."""

    service: ReferenceService
    store: Store

    def call(self, tenant: str, method: str, request: Any) -> Any:
        """The answer, or the error: code, text, field and reason."""
        call = Call("request", time.monotonic(), time.monotonic() + 60, Principal(tenant))
        try:
            return asyncio.run(getattr(self.service, method)(request, call))
        except RequestError as error:
            return (error.code, str(error), error.field, error.reason)
        except FieldError as error:
            return ("INVALID_ARGUMENT", str(error), error.field, "")

    def listed(self, tenant: str, method: str, request: Any, page_size: int) -> Any:
        """All pages."""
        found: list[Any] = []
        request.page_size = page_size
        while True:
            page = self.call(tenant, method, request)
            if isinstance(page, tuple):
                return page
            found += page.scenes if method == "ListScenes" else page.references
            if not page.next_page_token:
                return found
            request.page_token = page.next_page_token


@contextmanager
def serving(folder: Path) -> Iterator[Server]:
    with Store.open(folder) as store:
        engine = cast(Any, StandInEngine(store))
        service = ReferenceService(lambda: engine, store)
        try:
            yield Server(service, store)
        finally:
            service.close()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    with serving(tmp_path) as server:
        yield server


def requests_for(scene_id: str, reference_id: str) -> dict[str, Any]:
    """A good request of every RPC but CreateScene and ListScenes, which name no scene that must exist."""
    named = requests_on(scene_id, reference_id, "new")
    return {method.removeprefix(REFERENCE_SERVICE): it for method, it in named.items() if REFERENCE_SERVICE in method}


def seen(server: Server, tenant: str) -> Any:
    """Everything that a tenant can see."""
    scenes = server.listed(tenant, "ListScenes", pb.ListScenesRequest(), 2)
    return [
        (scene, server.listed(tenant, "ListReferences", pb.ListReferencesRequest(scene=scene.name), 2))
        for scene in scenes
    ]


def test_every_rpc_has_a_request_here() -> None:
    (service,) = pb.DESCRIPTOR.services_by_name.values()
    assert {method.name for method in service.methods} == {"CreateScene", "ListScenes", *requests_for("s", "r")}


def test_one_tenants_cache_is_not_read_by_another(server: Server) -> None:
    server.call("acme", "CreateScene", pb.CreateSceneRequest(scene_id="s"))
    server.call("acme", "CreateReference", new_reference("s", "r"))
    mine = key_of("acme", "s")
    assert len(server.store.load_references(mine, ["r"], "stand-in").references) == 1
    assert len(server.store.list_changes(mine, None, "").added) == 1
    look_ups: list[Callable[[SceneKey], Any]] = [
        lambda key: server.store.load_references(key, ["r"], "stand-in"),
        lambda key: server.store.load_references(key, None, "stand-in"),
        lambda key: server.store.list_changes(key, None, ""),
    ]
    for tenant in TENANTS:
        for look_up in look_ups if tenant != "acme" else []:
            with pytest.raises(NotFound, match="no scene 's'"):
                look_up(key_of(tenant, "s"))
        if tenant != "acme":
            # The same id and the same generation, and yet other references.
            server.call(tenant, "CreateScene", pb.CreateSceneRequest(scene_id="s"))
            server.call(tenant, "CreateReference", new_reference("s", f"of.{tenant}.own"))
            theirs = server.store.list_changes(key_of(tenant, "s"), None, "")
            assert [it.reference_id for it in theirs.added] == [f"of.{tenant}.own"]
            assert theirs.generation == server.store.get_scene(mine).generation


ENTANGLED = [DEFAULT_TENANT, "acme", "ACME", "acme0"]
operations = st.lists(
    st.tuples(
        st.sampled_from(ENTANGLED),
        st.sampled_from(["CreateScene", "CreateScene", "list", *requests_for("s", "r")]),
        st.sampled_from(["s", "acme"]),
        st.sampled_from(["r", "new"]),
        st.integers(1, 3),
    ),
    max_size=30,
)


@settings(max_examples=15, deadline=None)
@given(operations)
def test_a_tenant_gets_the_answers_of_a_server_of_its_own(
    tmp_path_factory: pytest.TempPathFactory, operations: list[tuple[str, str, str, str, int]]
) -> None:
    folder = tmp_path_factory.mktemp("tenants")
    with serving(folder / "shared") as shared:
        said: dict[str, list[Any]] = {tenant: [] for tenant in ENTANGLED}
        for operation in operations:
            said[operation[0]].append(perform(shared, operation[0], operation))
        for number, tenant in enumerate(ENTANGLED):
            with serving(folder / f"own-{number}") as own:
                own_said = [perform(own, DEFAULT_TENANT, it) for it in operations if it[0] == tenant]
                assert said[tenant] == own_said
                assert shown(seen(shared, tenant)) == shown(seen(own, DEFAULT_TENANT))


def perform(server: Server, tenant: str, operation: tuple[str, str, str, str, int]) -> str:
    """What a tenant is answered, as text, times apart."""
    _, method, scene_id, reference_id, page_size = operation
    if method == "list":
        return shown(server.listed(tenant, "ListScenes", pb.ListScenesRequest(), page_size))
    if method == "CreateScene":
        return shown(server.call(tenant, method, pb.CreateSceneRequest(scene_id=scene_id)))
    return shown(server.call(tenant, method, requests_for(scene_id, reference_id)[method]))


def shown(answer: Any) -> str:
    if isinstance(answer, list | tuple):
        return "\n".join(map(shown, answer))
    if hasattr(answer, "DESCRIPTOR"):
        return without_times(str(answer))
    return str(answer)


def without_times(text: str) -> str:
    """Drops the numbers of a create_time."""
    return "\n".join(line for line in text.splitlines() if not line.strip().startswith(("seconds:", "nanos:")))
