"""Keys of scenes, which no two tenants share, and limits; see also `service/test_security.py`."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless import wire
from mapless_server.security import (
    DEFAULT_TENANT,
    NOWHERE,
    SceneLimit,
    check_tenant,
    end_of_keys,
    key_of,
    scene_id_of,
    tenant_of,
)

ids = st.from_regex(r"\A[A-Za-z0-9_]([A-Za-z0-9_-]{0,6}[A-Za-z0-9_])?\Z")

names = st.sampled_from(["site", "floor"])
labels = st.dictionaries(names, st.sampled_from(["a", "b"]))


@given(st.frozensets(ids, max_size=2), labels, ids, labels)
def test_a_limit_holds_its_ids_and_those_with_all_labels(
    scene_ids: frozenset[str], needed: dict[str, str], scene_id: str, its: dict[str, str]
) -> None:
    if not scene_ids and not needed:
        with pytest.raises(ValueError, match="scene_ids or labels"):
            SceneLimit(scene_ids, frozenset(needed.items()))
        return
    is_labelled = bool(needed) and all(its.get(name) == value for name, value in needed.items())
    limit = SceneLimit(scene_ids, frozenset(needed.items()))
    assert limit.holds(scene_id, its) == (scene_id in scene_ids or is_labelled)


class TestKeys:
    @given(first=st.tuples(ids | st.just(DEFAULT_TENANT), ids), second=st.tuples(ids | st.just(DEFAULT_TENANT), ids))
    def test_no_two_scenes_share_a_key(self, first: tuple[str, str], second: tuple[str, str]) -> None:
        assert (key_of(*first) == key_of(*second)) == (first == second)

    @given(tenant=ids | st.just(DEFAULT_TENANT), other=ids, scene_id=ids)
    def test_a_key_gives_tenant_and_id_back_in_its_range(self, tenant: str, other: str, scene_id: str) -> None:
        key = key_of(check_tenant(tenant), wire.checked_id(scene_id, "scene_id"))
        assert (tenant_of(key), scene_id_of(key)) == (tenant, scene_id)
        assert (key == scene_id) == (tenant == DEFAULT_TENANT)
        assert (key_of(other, "") < key < end_of_keys(other)) == (other == tenant) or other == DEFAULT_TENANT

    def test_no_tenant_is_the_one_without_scenes(self) -> None:
        with pytest.raises(ValueError, match="an id is"):
            check_tenant(NOWHERE)
        assert tenant_of(key_of(NOWHERE, "hall")) == NOWHERE
        assert scene_id_of(key_of(NOWHERE, "hall")) == "hall"

    @pytest.mark.parametrize("name", ["", "a/b", "a b", ".", "a" * 129, "a\n", "ä"])
    def test_a_tenant_that_is_no_id_is_rejected(self, name: str) -> None:
        with pytest.raises(ValueError, match="an id is"):
            check_tenant(name)
