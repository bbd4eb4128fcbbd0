"""Descriptors: the limit that a server takes, and what is logged where connections use many of them."""

import resource
import subprocess
import sys

import pytest

from mapless_server.rpc import descriptors


async def test_many_connections_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    found = [0, 10**7, 10**7, 10**7, 0, 0]
    caplog.set_level("INFO")
    with pytest.raises(IndexError):
        await descriptors.watch_connections(lambda: found.pop(0), 0.01)
    said = [it.levelname for it in caplog.records if "connections are open" in it.message]
    assert said == ["WARNING", "INFO"]


def test_the_soft_limit_of_descriptors_becomes_the_hard_one() -> None:
    """And connections leave a part of it to all else."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1024:
        pytest.skip(f"the hard limit is {hard}")
    code = (
        "import resource\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (256, 1024))\n"
        "from mapless_server.rpc import descriptors as it\n"
        "it.raise_limit()\n"
        "print(resource.getrlimit(resource.RLIMIT_NOFILE)[0], it.most_connections(), it.handshake_s())\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert ran.stdout.split() == ["1024", "768", "3.0"]
    assert "raise the hard limit" in ran.stderr
