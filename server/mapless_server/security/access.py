"""Who may do what: callers and their roles, the keys of their scenes, tokens, and the role that each method needs.

A scene's key contains its tenant, and only this module makes and reads keys. The store and its caches use only keys, so
that scenes of another tenant do not exist for a caller. Callers use ids, and never see keys.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from enum import IntEnum
from functools import cached_property
from typing import Annotated, Literal, NewType

from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, model_validator

from mapless.labels import check_labels
from mapless.names import check_id
from mapless_server.errors import PermissionDenied, Unauthenticated

from .scene_limit import MAX_LIMIT_SCENES, SceneLimit

DEFAULT_TENANT = "default"
"""The tenant of all scenes on a server without tokens."""

NOWHERE = "~"
"""A tenant that has no scenes, since no tenant can have this name. The scenes that a token is not for are looked up
here, so that they are in everything as scenes that do not exist."""


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
    """A caller, with its rights on its tenant's scenes, and the name of its token or certificate, if any.

    For a caller with a limit only the scenes within it exist; None for all scenes of the tenant.
    """

    tenant: str = DEFAULT_TENANT
    role: Role = Role.WRITE
    name: str = ""
    limit: SceneLimit | None = None

    @property
    def holder(self) -> tuple[str, str]:
        """The tenant and the name, which together are unique."""
        return self.tenant, self.name


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


Name = Annotated[str, AfterValidator(check_id)]


class Token(BaseModel):
    """An entry of the file, with the unique name of its holder, and the hexadecimal hash of the token.

    With `scenes` or `labels` it is limited to the scenes of these ids, and to those with all of these labels.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Name
    tenant: Name = DEFAULT_TENANT
    role: Literal["read", "localize", "write"]
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    expires: AwareDatetime | None = None
    scenes: tuple[Name, ...] | None = Field(default=None, min_length=1, max_length=MAX_LIMIT_SCENES)
    labels: Annotated[dict[str, str], AfterValidator(check_labels)] | None = Field(default=None, min_length=1)

    @cached_property
    def limit(self) -> SceneLimit | None:
        """The scenes that it is limited to; None for all of its tenant."""
        if self.scenes is None and self.labels is None:
            return None
        return SceneLimit(frozenset(self.scenes or ()), frozenset((self.labels or {}).items()))

    @property
    def allows(self) -> Role:
        """The role as an enum."""
        return Role[self.role.upper()]


class TenantLimits(BaseModel):
    """Limits of one tenant; `rate_ms` replaces the setting tenant_rate_ms, 0 for no limit."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate_ms: float | None = Field(default=None, ge=0, allow_inf_nan=False)


class Tokens(BaseModel):
    """The contents of the file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tokens: tuple[Token, ...] = ()
    tenants: dict[Name, TenantLimits] = {}

    @model_validator(mode="after")
    def _check_unique(self) -> "Tokens":
        for what, values in (("name", [it.name for it in self.tokens]), ("sha256", [it.sha256 for it in self.tokens])):
            value, count = next(iter(Counter(values).most_common(1)), ("", 0))
            if count > 1:
                raise ValueError(f"two tokens have the {what} {value!r}")
        return self

    def find(self, token: str) -> Token | None:
        """The entry of a token; None if it is unknown.

        The look-up is by hash, so its duration depends only on the caller's own token.
        """
        return self._by_hash.get(sha256_of(token))

    def rate_ms(self, tenant: str) -> float | None:
        """Computing time that a tenant may use, milliseconds per second; None if the file does not set it."""
        limits = self.tenants.get(tenant)
        return limits.rate_ms if limits else None

    @cached_property
    def _by_hash(self) -> dict[str, Token]:
        return {it.sha256: it for it in self.tokens}


def sha256_of(token: str) -> str:
    """The hash of a token, hexadecimal."""
    return hashlib.sha256(token.encode()).hexdigest()


METHOD_ROLES: Mapping[str, Role] = {
    "/mapless.v1.LocalizationService/Localize": Role.LOCALIZE,
    "/mapless.v1.LocalizationService/LocalizeProgressively": Role.LOCALIZE,
    "/mapless.v1.LocalizationService/LocalizeRig": Role.LOCALIZE,
    "/mapless.v1.LocalizationService/LocalizeSequence": Role.LOCALIZE,
    # It shows other callers' photographs.
    "/mapless.v1.LocalizationService/WatchQueries": Role.WRITE,
    "/mapless.v1.ReferenceService/CreateScene": Role.WRITE,
    "/mapless.v1.ReferenceService/GetScene": Role.READ,
    "/mapless.v1.ReferenceService/ListScenes": Role.READ,
    "/mapless.v1.ReferenceService/UpdateScene": Role.WRITE,
    "/mapless.v1.ReferenceService/DeleteScene": Role.WRITE,
    "/mapless.v1.ReferenceService/CreateReference": Role.WRITE,
    "/mapless.v1.ReferenceService/BatchCreateReferences": Role.WRITE,
    "/mapless.v1.ReferenceService/GetReference": Role.READ,
    "/mapless.v1.ReferenceService/ListReferences": Role.READ,
    "/mapless.v1.ReferenceService/DeleteReference": Role.WRITE,
    "/mapless.v1.ReferenceService/RetireReference": Role.WRITE,
    "/mapless.v1.ReferenceService/RestoreReference": Role.WRITE,
    "/mapless.v1.ReferenceService/RestoreReferences": Role.WRITE,
    "/mapless.v1.ReferenceService/RetrieveReferences": Role.LOCALIZE,
    "/mapless.v1.ReferenceService/AuditScene": Role.WRITE,
    "/mapless.v1.ReferenceService/GetSceneReport": Role.READ,
    "/mapless.v1.ReferenceService/CheckCoverage": Role.LOCALIZE,
}
"""The least role that a caller of the method must have."""

OPEN_METHODS = frozenset(
    {
        # Probes and load balancers have no token.
        "/grpc.health.v1.Health/Check",
        "/grpc.health.v1.Health/List",
        "/grpc.health.v1.Health/Watch",
        # The interface is published; the setting `reflection` turns this off.
        "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
    }
)
"""Methods without authentication; none of them shows anything of scenes."""

ENDLESS_METHODS = frozenset({"/mapless.v1.LocalizationService/WatchQueries"})
"""Streams that last until their caller ends them: they have no deadline but the caller's own, a drain does not wait for
them, and the caller is authenticated again before each message. All other calls have a deadline, streams too."""

_KEY = "authorization"
_SCHEME = "bearer"
_MAX_NAME_CHARACTERS = 128

Metadata = Iterable[tuple[str, str | bytes]]


class Authenticator:
    """Authenticates callers by their bearer token; without tokens, every caller has all rights."""

    def __init__(
        self, tokens: Callable[[], Tokens] | None, now: Callable[[], datetime] = lambda: datetime.now(timezone.utc)
    ) -> None:
        """The function `tokens` returns the current tokens; None if callers need no token."""
        self._tokens = tokens
        self._now = now

    def authenticate(
        self, metadata: Metadata, method: str, auth_context: Mapping[str, Iterable[bytes]] | None = None
    ) -> Principal:
        """Authenticates the caller of a method ("/package.Service/Method"), and checks that it may call the method.

        `auth_context` has the connection's facts about the caller, `context.auth_context()`. Unauthenticated for no
        token (TOKEN_MISSING), an unknown or revoked one (TOKEN_INVALID), or an expired one (TOKEN_EXPIRED);
        PermissionDenied if the token's role is too low, or the method is not in the table METHOD_ROLES.
        """
        needed = METHOD_ROLES.get(method)
        if needed is None:
            raise PermissionDenied("this method cannot be called", reason="METHOD_NOT_ALLOWED")
        if self._tokens is None:
            return Principal(name=certificate_name(auth_context or {}))
        token = self._tokens().find(_bearer_token(metadata))
        if token is None:
            raise Unauthenticated("the token is unknown", reason="TOKEN_INVALID")
        if token.expires is not None and token.expires <= self._now():
            raise Unauthenticated("the token has expired", reason="TOKEN_EXPIRED")
        if token.allows < needed:
            raise PermissionDenied(
                f"this method takes a token of the role {needed.name.lower()}; the token {token.name!r} has the role "
                f"{token.role}",
                reason="ROLE_TOO_LOW",
            )
        return Principal(token.tenant, token.allows, token.name, token.limit)


def certificate_name(auth_context: Mapping[str, Iterable[bytes]]) -> str:
    """The name in the client's certificate, in a form for the log; empty without a certificate."""
    for key in ("x509_common_name", "x509_subject_alternative_name", "x509_subject"):
        for value in auth_context.get(key, ()):
            text = value.decode(errors="replace")
            return "".join(c if c.isprintable() else "?" for c in text)[:_MAX_NAME_CHARACTERS]
    return ""


def _bearer_token(metadata: Metadata) -> str:
    values = [value for key, value in metadata if key == _KEY]
    if not values:
        raise Unauthenticated("a token is required: metadata 'authorization: Bearer <token>'", reason="TOKEN_MISSING")
    scheme, _, token = str(values[0]).partition(" ")
    if len(values) > 1 or scheme.lower() != _SCHEME or not token:
        raise Unauthenticated("the metadata 'authorization' must be one 'Bearer <token>'", reason="TOKEN_INVALID")
    return token.strip()
