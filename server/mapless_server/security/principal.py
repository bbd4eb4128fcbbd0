"""An authenticated caller and its role."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

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
    """A caller.

    Attributes:
        tenant: whose scenes it can access.
        role: its rights on them.
        name: of its token or certificate, for the log; empty without either.
    """

    tenant: str = DEFAULT_TENANT
    role: Role = Role.WRITE
    name: str = ""
