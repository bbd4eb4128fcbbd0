"""Gateways as their command starts them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

ANNOUNCEMENT = "mapless-server gateway is on "


@contextmanager
def running_gateway(address: str, *flags: str) -> Iterator[str]:
    """The URL of a gateway in front of a server, until the block is left."""
    command = [sys.executable, "-m", "mapless_tools", "gateway", "--address", address, "--port", "0", *flags]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line.startswith(ANNOUNCEMENT), line
        yield line.removeprefix(ANNOUNCEMENT).strip()
    finally:
        process.terminate()
        process.wait(30)
        process.stdout.close()
