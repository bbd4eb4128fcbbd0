"""What protects a server, put together from its settings."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from mapless_server.settings import Settings

from .access import Authenticator
from .binding import Verdict, advise
from .errors import SecurityError
from .rate import RateLimiter
from .reloading import Refreshable, Reloading
from .tls import Tls, TlsFiles
from .tokens import Tokens, read_tokens

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Protection:
    """What protects the server; made from the settings' files, and kept up to date with them."""

    tls: Tls | None
    tokens: Reloading[Tokens] | None
    quota: RateLimiter | None

    @staticmethod
    def of(settings: Settings) -> Protection:
        """SecurityError if a file cannot be used, or the server would be open to the world by accident."""
        advice = advise(
            settings.host,
            tls=settings.tls_certificate is not None,
            client_certificates=settings.tls_client_ca is not None,
            tokens=settings.tokens_file is not None,
            insecure=settings.insecure,
        )
        if advice.verdict is Verdict.REFUSED:
            raise SecurityError(advice.sentence)
        if advice.sentence:
            log.log(logging.WARNING if advice.verdict is Verdict.WARNING else logging.INFO, "%s", advice.sentence)
        tls = tokens = None
        if settings.tls_certificate is not None and settings.tls_key is not None:
            tls = Tls(TlsFiles(settings.tls_certificate, settings.tls_key, settings.tls_client_ca))
        if (path := settings.tokens_file) is not None:
            tokens = Reloading([path], lambda: read_tokens(path), "tokens")
        return Protection(tls, tokens, _make_quota(settings, tokens))

    @property
    def authenticator(self) -> Authenticator:
        """Finds out who calls."""
        tokens = self.tokens
        return Authenticator(None if tokens is None else lambda: tokens.value)

    @property
    def refreshable(self) -> list[Refreshable]:
        """What follows files."""
        return [it for it in (self.tls, self.tokens) if it is not None]


def _make_quota(settings: Settings, tokens: Reloading[Tokens] | None) -> RateLimiter | None:
    def own_rate(tenant: str) -> float | None:
        own_ms = None if tokens is None else tokens.value.rate_ms(tenant)
        return None if own_ms is None else own_ms / 1000

    if not settings.tenant_rate_ms and tokens is None:
        return None
    return RateLimiter(settings.tenant_rate_ms / 1000, settings.tenant_burst_ms / 1000, own_rate)
