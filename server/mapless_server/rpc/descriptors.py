"""File descriptors, of which every connection takes one: their limit, and how many connections there may be and are.

gRPC neither counts connections nor those that it ends before their first call; the kernel's table of sockets does count
the open ones.
"""

import asyncio
import logging
import resource
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

MOST_DESCRIPTORS = 2**20
"""No limit is raised beyond: some programs go through all possible descriptors."""
RESERVED_SHARE, MOST_RESERVED = 0.25, 512
"""Share of the descriptors that connections leave to the store, the log, the metrics and probes, and its maximum."""
FEW_CONNECTIONS = 4096
"""A server with fewer connections is said to have too few: strangers that open them can keep others out."""
HANDSHAKE_S, SHORT_HANDSHAKE_S = 10.0, 3.0
"""Time for TLS and the preface of HTTP/2; the short one where there are few connections. Evidence: handshake."""
CHECK_INTERVAL_S = 5.0
FULL_SHARE = 0.8
"""Share of the allowed connections from which on the log warns."""

_TABLES = ("/proc/self/net/tcp", "/proc/self/net/tcp6")
_OPEN_STATES = frozenset({"01", "08"})
"""Established, or ended by the other side only."""

log = logging.getLogger(__name__)


def raise_limit() -> None:
    """Raises the limit of descriptors as far as this process may, and logs it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, MOST_DESCRIPTORS)
    if wanted > soft != resource.RLIM_INFINITY:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
    fields = {"descriptors": _limit(), "descriptors_before": soft, "connections": most_connections()}
    words = "up to %d connections at a time, of a limit of %d file descriptors"
    if most_connections() >= FEW_CONNECTIONS:
        log.info(words, most_connections(), _limit(), extra={"fields": fields})
    else:
        advice = "; raise the hard limit (LimitNOFILE, --ulimit nofile): strangers that open as many keep others out"
        log.warning(words + advice, most_connections(), _limit(), extra={"fields": fields})


def most_connections() -> int:
    """Number of connections that the limit of descriptors allows, beside what else needs one."""
    limit = _limit()
    return limit - min(MOST_RESERVED, int(RESERVED_SHARE * limit))


def handshake_s() -> float:
    """Time in which a connection must be ready for calls."""
    return HANDSHAKE_S if most_connections() >= FEW_CONNECTIONS else SHORT_HANDSHAKE_S


def open_connections(port: int) -> int:
    """Number of open TCP connections to a port of this machine (in a container, of the container); 0 without /proc."""
    ending, count = f":{port:04X}", 0
    for table in map(Path, _TABLES):
        with suppress(OSError):
            rows = [line.split() for line in table.read_text().splitlines()[1:]]
            count += sum(row[1].endswith(ending) and row[3] in _OPEN_STATES for row in rows if len(row) > 3)
    return count


async def watch_connections(count: Callable[[], int], interval_s: float = CHECK_INTERVAL_S) -> None:
    """Logs when connections become many, and when they are fewer again, until it is cancelled."""
    were_many = False
    while True:
        found, most = await asyncio.to_thread(count), most_connections()
        are_many = found > FULL_SHARE * most
        if are_many and not were_many:
            log.warning("%d of %d connections are open: further ones are refused when all are", found, most)
        elif were_many and not are_many:
            log.info("%d of %d connections are open", found, most)
        were_many = are_many
        await asyncio.sleep(interval_s)


def _limit() -> int:
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return sys.maxsize if soft == resource.RLIM_INFINITY else soft
