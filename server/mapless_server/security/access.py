"""Authentication and authorization: one table has the role that each method needs; other methods are rejected."""

from collections.abc import Callable, Iterable, Mapping
from datetime import datetime, timezone

from mapless_server.errors import PermissionDenied, Unauthenticated

from .tenancy import Principal, Role
from .tokens import Tokens

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
    "/mapless.v1.ReferenceService/RetrieveReferences": Role.LOCALIZE,
    "/mapless.v1.ReferenceService/AuditScene": Role.WRITE,
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
        return Principal(token.tenant, token.allows, token.name)


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
