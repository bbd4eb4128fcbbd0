"""Whose a scene is: below the service, a scene is known by a key that says so, and here alone keys are made and read.

The store and its caches know scenes by their keys only, so that a scene of another tenant is one that does not exist.
Callers see ids, and never learn that there are keys.
"""

from __future__ import annotations

from typing import NewType

from mapless.names import check_id

from .principal import DEFAULT_TENANT

SceneKey = NewType("SceneKey", str)
"""The id of a scene of the default tenant, as in stores that never knew another; "tenant/scene" for all others.

Neither tenants nor ids hold a slash, so that no two scenes share a key.
"""

KEY_SEPARATOR = "/"
_NEXT_CHARACTER = "0"


def check_tenant(tenant: str) -> str:
    """The tenant's name, unchanged; ValueError if it is not one: the rules are those of ids."""
    return check_id(tenant)


def key_of(tenant: str, scene_id: str) -> SceneKey:
    """The key of a tenant's scene; both names must have been checked."""
    return SceneKey(scene_id if tenant == DEFAULT_TENANT else f"{tenant}{KEY_SEPARATOR}{scene_id}")


def tenant_of(key: SceneKey) -> str:
    """Whose scene it is."""
    tenant, separator, _ = key.partition(KEY_SEPARATOR)
    return tenant if separator else DEFAULT_TENANT


def scene_id_of(key: SceneKey) -> str:
    """The scene's id, by which its tenant knows it."""
    tenant, separator, scene_id = key.partition(KEY_SEPARATOR)
    return scene_id if separator else tenant


def end_of_keys(tenant: str) -> str:
    """The first text, by code point, after all keys of a tenant that is not the default one.

    Between "tenant/" and "tenant0" lie the tenant's keys and nothing else.
    """
    return f"{tenant}{_NEXT_CHARACTER}"
