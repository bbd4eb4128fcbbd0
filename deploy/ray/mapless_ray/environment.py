"""Environment variables of `ray start`, on every node: what a Serve config cannot set.

`python -m mapless_ray.environment` prints them for a shell; the manifests repeat them, and a test compares.
"""

import os
import shlex
from collections.abc import Mapping

from mapless_server.serve.startup import StartupError
from mapless_server.settings import Settings

LEAVING_S = 10.0
"""Time for which a replica that ends still accepts calls: HAProxy removes it in one or two seconds, on a busy machine
in five. Serve's default of 30 s would only make redeploys slower."""

_MIB = 2**20

WINDOW_BYTES = _MIB
"""Data of one call in transit without acknowledgement: a photograph. HAProxy's default is 64 KiB a round trip."""

_BALANCING = """\
hdr(x-mapless-scene)
    hash-type consistent
    hash-balance-factor 150
"""
"""Calls of a scene go to the replica that has its references in memory, unless it has 1.5 times as many calls as the
average; calls without a scene go to the replicas by turns."""

_LOST = """\
    http-error status {} content-type application/grpc hdr grpc-status 14 hdr grpc-message "{}"
"""
"""UNAVAILABLE, which clients retry, instead of Serve's HTTP 500, which gRPC reports as UNKNOWN."""


def variables(max_message_mib: int = 32, leaving_s: float = LEAVING_S) -> dict[str, str]:
    """Returns the variables, for a setting `max_message_mib`, which Serve's gRPC servers do not read.

    Serve's template of HAProxy's configuration ends its section for all proxies with the balancing algorithm, so that
    further lines in that variable are further lines of the section.
    """
    lost = _LOST.format(502, "the replica ended") + _LOST.format(503, "no replica took the call")
    lost += _LOST.format(504, "the replica does not answer")
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
    """StartupError if a variable without which calls fail is missing or contradicts the settings."""
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
