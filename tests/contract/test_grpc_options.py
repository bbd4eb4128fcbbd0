"""Every option of a channel or a server is known to gRPC, which ignores misspelt ones silently."""

import re
from pathlib import Path

import pytest
from grpc._cython import cygrpc

import mapless
import mapless_server

KNOWN = Path(cygrpc.__file__).read_bytes()
SOURCES = [path for package in (mapless, mapless_server) for path in Path(package.__path__[0]).rglob("*.py")]
OPTIONS = sorted({name for path in SOURCES for name in re.findall(r'\("(grpc\.[a-z0-9_.]+)",', path.read_text())})


def test_some_are_given() -> None:
    assert {"grpc.keepalive_time_ms", "grpc.max_receive_message_length"} <= set(OPTIONS)


@pytest.mark.parametrize("name", OPTIONS)
def test_grpc_knows_the_option(name: str) -> None:
    assert name.encode() + b"\0" in KNOWN
