"""Who calls, and whether they may: every method has its role in one table, and what is not in it is refused."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from datetime import datetime, timezone

from mapless_server.errors import PermissionDenied, Unauthenticated

from .principal import Principal, Role
from .tokens import Tokens

METHOD_ROLES: Mapping[str, Role] = {
    "/mapless.v1.LocalizationService/Localize": Role.LOCALIZE,
    "/mapless.v1.LocalizationService/LocalizeProgressively": Role.LOCALIZE,
    "/mapless.v1.LocalizationService/LocalizeRig": Role.LOCALIZE,
    "/mapless.v1.LocalizationService/LocalizeSequence": Role.LOCALIZE,
    # Other callers' photographs are shown.
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
    "/mapless.v1.ReferenceService/RetrieveReferences": Role.LOCALIZE,
    "/mapless.v1.ReferenceService/AuditScene": Role.WRITE,
    "/mapless.v1.ReferenceService/CheckCoverage": Role.LOCALIZE,
}
"""What a caller must be allowed at least."""

OPEN_METHODS = frozenset(
    {
        # Probes and load balancers hold no token.
        "/grpc.health.v1.Health/Check",
        "/grpc.health.v1.Health/List",
        "/grpc.health.v1.Health/Watch",
        # The interface is published; the setting `reflection` turns this off.
        "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
    }
)
"""What anybody may call; nothing of it tells of scenes."""

ENDLESS_METHODS = frozenset({"/mapless.v1.LocalizationService/WatchQueries"})
"""Streams that last until their caller has seen enough: they have no deadline but the caller's own, nobody waits for
their end, and whether the caller may is asked again before each message. All other calls end in time, streams too."""

_KEY = "authorization"
_SCHEME = "bearer"
_MAX_NAME_CHARACTERS = 128

Metadata = Iterable[tuple[str, str | bytes]]


class Authenticator:
    """Finds out who calls by the bearer token; without tokens, everybody who can connect may do everything."""

    def __init__(
        self,
        tokens: Callable[[], Tokens] | None,
        now: Callable[[], datetime] = lambda: datetime.now(timezone.utc),
    ) -> None:
        """`tokens` gives those that are good at the moment; None if none are asked for."""
        self._tokens = tokens
        self._now = now

    def authenticate(
        self, metadata: Metadata, method: str, auth_context: Mapping[str, Iterable[bytes]] | None = None
    ) -> Principal:
        """Who calls a method, which they may.

        Args:
            metadata: of the call.
            method: "/package.Service/Method", one of METHOD_ROLES.
            auth_context: what the connection knows of the caller, `context.auth_context()`.

        Raises:
            Unauthenticated: no token (TOKEN_MISSING), none of ours (TOKEN_INVALID, also if it was revoked), or one
                whose time is over (TOKEN_EXPIRED).
            PermissionDenied: the token's role is not enough, or the method is not in the table.
        """
        needed = METHOD_ROLES.get(method)
        if needed is None:
            raise PermissionDenied("nobody may call this method", reason="METHOD_NOT_ALLOWED")
        if self._tokens is None:
            return Principal(name=certificate_name(auth_context or {}))
        token = self._tokens().find(_bearer_token(metadata))
        if token is None:
            raise Unauthenticated("the token is not known", reason="TOKEN_INVALID")
        if token.expires is not None and token.expires <= self._now():
            raise Unauthenticated("the token has expired", reason="TOKEN_EXPIRED")
        if token.allows < needed:
            raise PermissionDenied(
                f"this takes a token of the role {needed.name.lower()}; the one given, {token.name!r}, has the role "
                f"{token.role}",
                reason="ROLE_TOO_LOW",
            )
        return Principal(token.tenant, token.allows, token.name)


def certificate_name(auth_context: Mapping[str, Iterable[bytes]]) -> str:
    """Whom the client's certificate names, fit for the log; empty if it showed none."""
    for key in ("x509_common_name", "x509_subject_alternative_name", "x509_subject"):
        for value in auth_context.get(key, ()):
            text = value.decode(errors="replace")
            return "".join(c if c.isprintable() else "?" for c in text)[:_MAX_NAME_CHARACTERS]
    return ""


def _bearer_token(metadata: Metadata) -> str:
    values = [value for key, value in metadata if key == _KEY]
    if not values:
        raise Unauthenticated("a token is needed: metadata 'authorization: Bearer <token>'", reason="TOKEN_MISSING")
    scheme, _, token = str(values[0]).partition(" ")
    if len(values) > 1 or scheme.lower() != _SCHEME or not token:
        raise Unauthenticated("the metadata 'authorization' must be one 'Bearer <token>'", reason="TOKEN_INVALID")
    return token.strip()
