"""The protection of a server, made from its settings."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mapless_server.settings import Settings

from .access import Authenticator, Tokens
from .binding import assess_binding
from .rate import RateLimiter
from .reloading import Reloading, SecurityError
from .tokens import read_tokens, warn_of_readers

if TYPE_CHECKING:
    from .tls import Tls

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Protection:
    """TLS, tokens and quota of a server; `refreshes` follow changes of their files."""

    tls: "Tls | None"
    tokens: Reloading[Tokens] | None
    quota: RateLimiter | None

    @staticmethod
    def of(settings: Settings) -> "Protection":
        """Raises SecurityError if a file cannot be used, or the server would listen without protection by accident."""
        level, sentence = assess_binding(settings)
        if level == logging.CRITICAL:
            raise SecurityError(sentence)
        if sentence:
            log.log(level, "%s", sentence)
        for secret in filter(None, (settings.tokens_file, settings.tls_key)):
            warn_of_readers(secret)
        tls = tokens = None
        if settings.tls_certificate is not None and settings.tls_key is not None:
            from .tls import Tls, TlsFiles  # cryptography's X.509, a twentieth of what a server imports

            tls = Tls(TlsFiles(settings.tls_certificate, settings.tls_key, settings.tls_client_ca))
        if (path := settings.tokens_file) is not None:
            tokens = Reloading([path], lambda: read_tokens(path), "tokens")
        return Protection(tls, tokens, _make_quota(settings, tokens))

    @property
    def authenticator(self) -> Authenticator:
        """Authenticates callers by the current tokens."""
        tokens = self.tokens
        return Authenticator(None if tokens is None else lambda: tokens.value)

    @property
    def refreshes(self) -> list[Callable[[], bool]]:
        """Functions that read a changed file again, see `Reloading.refresh`."""
        return [it.refresh for it in (self.tls, self.tokens) if it is not None]


def _make_quota(settings: Settings, tokens: Reloading[Tokens] | None) -> RateLimiter | None:
    def own_rate(tenant: str) -> float | None:
        own_ms = None if tokens is None else tokens.value.rate_ms(tenant)
        return None if own_ms is None else own_ms / 1000

    if not settings.tenant_rate_ms and tokens is None:
        return None
    return RateLimiter(settings.tenant_rate_ms / 1000, settings.tenant_burst_ms / 1000, own_rate)
