"""What a Ray cluster has to be told beside the Serve config: environment variables of `ray start`, on every node.

Serve takes these from nowhere else. `python -m mapless_ray.environment` prints them for a shell; the manifests repeat
them, and a test compares.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping

from mapless_server.serve.assembly import StartupError
from mapless_server.settings import Settings

LEAVING_S = 10.0
"""How long a replica that is to go still answers before it takes no more calls: HAProxy has forgotten it in one or two
seconds, on a busy machine in five. Serve's own 30 s would only make redeploys slower."""

_MIB = 2**20

WINDOW_BYTES = _MIB
"""What may be on the way of one call without an acknowledgement: a photograph, rather than HAProxy's 64 KiB, each of
which would wait for the next round trip."""

_BALANCING = """\
hdr(x-mapless-scene)
    hash-type consistent
    hash-balance-factor 150
"""
"""Calls of a scene go to the replica that has its references in memory, unless it has half as many calls again as the
others have on average; calls that name none go around."""

_LOST = """\
    http-error status {} content-type application/grpc hdr grpc-status 14 hdr grpc-message "{}"
"""
"""Serve has HAProxy answer with HTTP 500, which gRPC makes UNKNOWN of, and nobody tries UNKNOWN again."""


def variables(max_message_mib: int = 32, leaving_s: float = LEAVING_S) -> dict[str, str]:
    """The variables.

    HAProxy's configuration is a template of Serve's whose section for all proxies ends with the way of balancing: what
    follows that, in the same variable, are further lines of the section.

    Args:
        max_message_mib: as in the settings, which Serve's gRPC servers do not know.
        leaving_s: see `LEAVING_S`.
    """
    lost = _LOST.format(502, "the replica ended") + _LOST.format(503, "no replica took the call")
    lost += _LOST.format(504, "the replica fell silent")
    return {
        "RAY_SERVE_ENABLE_HA_PROXY": "1",
        # The replica lives in the event loop in which its gRPC server calls it.
        "RAY_SERVE_RUN_USER_CODE_IN_SEPARATE_THREAD": "0",
        "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE": str(max_message_mib * _MIB),
        "RAY_SERVE_HAPROXY_BALANCE_ALGORITHM": (_BALANCING + lost).rstrip(),
        "RAY_SERVE_HAPROXY_H2_FE_INITIAL_WINDOW_SIZE": str(WINDOW_BYTES),
        "RAY_SERVE_HAPROXY_H2_BE_INITIAL_WINDOW_SIZE": str(WINDOW_BYTES),
        "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": f"{leaving_s:g}",
    }


def check_environment(settings: Settings, environment: Mapping[str, str] = os.environ) -> None:
    """Looks for what callers would otherwise notice first.

    Raises:
        StartupError: a variable is missing or contradicts the settings.
    """
    wanted = variables(settings.max_message_mib)
    for name in (
        "RAY_SERVE_ENABLE_HA_PROXY",
        "RAY_SERVE_RUN_USER_CODE_IN_SEPARATE_THREAD",
        "RAY_SERVE_GRPC_MAX_MESSAGE_SIZE",
    ):
        if environment.get(name) != wanted[name]:
            raise StartupError(f"Ray was started without {name}={wanted[name]} in its environment: see deploy/ray")


if __name__ == "__main__":
    for variable, content in variables().items():
        print(f"export {variable}={shlex.quote(content)}")
