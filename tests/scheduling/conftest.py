"""No exception may reach only the event loop."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def _nothing_unhandled(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """An exception that reaches only the loop is a failure."""
    yield
    logged = [*caplog.get_records("call"), *caplog.get_records("teardown")]
    assert not [it for it in logged if it.name == "asyncio" and it.levelname == "ERROR"]
