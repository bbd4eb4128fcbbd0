"""Who calls, and what they may do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

DEFAULT_TENANT = "default"
"""Whose the scenes are on a server that asks nobody for a token."""


class Role(IntEnum):
    """What a caller may do; each may also do what those before it may."""

    READ = 1
    """Look at scenes and references."""
    LOCALIZE = 2
    """Localize photographs."""
    WRITE = 3
    """Create and delete scenes and references."""


@dataclass(frozen=True)
class Principal:
    """A caller.

    Attributes:
        tenant: whose scenes it sees.
        role: what it may do with them.
        name: of its token, for the log; empty without tokens.
    """

    tenant: str = DEFAULT_TENANT
    role: Role = Role.WRITE
    name: str = ""
