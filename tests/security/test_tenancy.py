"""Keys of scenes: no two tenants share one. That none sees another's is tested in `service/test_security.py`."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless import wire
from mapless_server.security import (
    DEFAULT_TENANT,
    check_tenant,
    end_of_keys,
    key_of,
    scene_id_of,
    tenant_of,
)

ids = st.from_regex(r"\A[A-Za-z0-9_]([A-Za-z0-9_-]{0,6}[A-Za-z0-9_])?\Z")


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

    @pytest.mark.parametrize("name", ["", "a/b", "a b", ".", "a" * 129, "a\n", "ä"])
    def test_a_tenant_that_is_no_id_is_rejected(self, name: str) -> None:
        with pytest.raises(ValueError, match="an id is"):
            check_tenant(name)
