"""Access control: tokens, TLS, tenancy, the address to listen on, and each tenant's computing time.

Imports only errors and settings. Begin with `protection.Protection`, which is made from the settings, and
`METHOD_ROLES` in `access`, the role that each method needs; `access` also has the keys of scenes, which all rooms below
the services use. `protection` and `tls` are imported by name: a store needs keys of scenes, and no TLS.
"""

from .access import (
    DEFAULT_TENANT,
    ENDLESS_METHODS,
    KEY_SEPARATOR,
    METHOD_ROLES,
    NOWHERE,
    OPEN_METHODS,
    Authenticator,
    Principal,
    Role,
    SceneKey,
    Tokens,
    certificate_name,
    check_tenant,
    end_of_keys,
    key_of,
    scene_id_of,
    sha256_of,
    tenant_of,
)
from .binding import assess_binding, is_loopback
from .rate import RateLimiter
from .reloading import SecurityError
from .scene_limit import SceneLimit
from .tokens import create_token, read_tokens, revoke_token, written_secret
