"""Commands that announce where they are, as a user starts them."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def running_command(name: str, *arguments: str) -> Iterator[str]:
    """The URL that `mapless-server NAME` announces, until the block is left, which terminates it."""
    announcement = f"mapless-server {name} is on "
    command = [sys.executable, "-m", "mapless_tools", name, *arguments, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            assert line.startswith(announcement), line
            yield line.removeprefix(announcement).strip()
        finally:
            process.terminate()
            assert process.wait(30) == 128 + signal.SIGTERM


@contextmanager
def running_gateway(address: str, *flags: str) -> Iterator[str]:
    """The URL of a gateway in front of a server, until the block is left."""
    with running_command("gateway", "--address", address, *flags) as url:
        yield url
