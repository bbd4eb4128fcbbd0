"""Callers, and keys of scenes, which contain the scene's tenant. Only this module makes and reads keys.

The store and its caches use only keys, so that scenes of another tenant do not exist for a caller. Callers use ids, and
never see keys.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import NewType

from mapless.names import check_id

DEFAULT_TENANT = "default"
"""The tenant of all scenes on a server without tokens."""


class Role(IntEnum):
    """The rights of a caller; each role includes those before it."""

    READ = 1
    """Read scenes and references."""
    LOCALIZE = 2
    """Localize photographs."""
    WRITE = 3
    """Create and delete scenes and references."""


@dataclass(frozen=True)
class Principal:
    """A caller, with its rights on its tenant's scenes, and the name of its token or certificate, if any."""

    tenant: str = DEFAULT_TENANT
    role: Role = Role.WRITE
    name: str = ""


SceneKey = NewType("SceneKey", str)
"""The id of a scene of the default tenant, as in stores without tenants; "tenant/scene" for all others.

Neither tenants nor ids contain a slash, so that no two scenes share a key.
"""

KEY_SEPARATOR = "/"
_NEXT_CHARACTER = "0"


def check_tenant(tenant: str) -> str:
    """Returns the tenant's name; raises ValueError if it breaks the rules, which are those of ids."""
    return check_id(tenant)


def key_of(tenant: str, scene_id: str) -> SceneKey:
    """The key of a tenant's scene; both names must have been checked."""
    return SceneKey(scene_id if tenant == DEFAULT_TENANT else f"{tenant}{KEY_SEPARATOR}{scene_id}")


def tenant_of(key: SceneKey) -> str:
    """The tenant of a scene."""
    tenant, separator, _ = key.partition(KEY_SEPARATOR)
    return tenant if separator else DEFAULT_TENANT


def scene_id_of(key: SceneKey) -> str:
    """The scene's id among those of its tenant."""
    tenant, separator, scene_id = key.partition(KEY_SEPARATOR)
    return scene_id if separator else tenant


def end_of_keys(tenant: str) -> str:
    """The first text, by code point, after all keys of a tenant that is not the default one.

    Between "tenant/" and "tenant0" there are only the tenant's keys.
    """
    return f"{tenant}{_NEXT_CHARACTER}"
