"""Callers that send or read late or not at all, and those that come again at once, take nothing from the others."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from mapless_server.errors import Overloaded
from mapless_server.rpc import sending
from mapless_server.rpc.sending import Unread


class Answered:
    """A call whose answer its caller may read."""

    def __init__(self) -> None:
        self._when_read: Callable[[object], None] = lambda _: None

    def add_done_callback(self, callback: Callable[[object], None]) -> None:
        self._when_read = callback

    def is_read(self) -> None:
        self._when_read(self)


def test_unread_answers_of_a_tenant_are_limited_but_for_small_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """One alone may be of any size; what is read makes room again, and other tenants' answers take none."""
    monkeypatch.setattr(sending, "UNREAD_BYTES", 1000)
    monkeypatch.setattr(sending, "SMALL_ANSWER_BYTES", 100)
    unread = Unread()

    def answer(size_bytes: int, tenant: str = "ours") -> Answered:
        call = Answered()
        unread.add(tenant, size_bytes, cast(Any, call))
        return call

    first = answer(1500)
    assert answer(400, "theirs")
    small = answer(100)
    with pytest.raises(Overloaded, match="wait to be read") as refused:
        answer(101)
    assert refused.value.reason == "UNREAD_ANSWERS"
    assert refused.value.retry_after_s
    first.is_read()
    large = answer(900)
    with pytest.raises(Overloaded):
        answer(101)
    for it in (small, large):
        it.is_read()
    assert answer(1500)
