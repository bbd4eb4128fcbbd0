"""Metrics and traces of calls."""

from __future__ import annotations

import logging

import pytest
from support.guarded import (
    Counted,
)


@pytest.fixture
def counted(caplog: pytest.LogCaptureFixture) -> Counted:
    caplog.set_level(logging.INFO, "mapless_server.rpc.guard")
    return Counted()
