"""Photographs that wait to be considered as references, of several tenants."""

import asyncio
import time
from collections import Counter
from datetime import datetime, timezone
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from mapless_server.engine.query import Query, Result
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.scenes.adoption.policy import AdoptionOptions, Evidence
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import key_of
from mapless_server.serve.adoption import adopter
from mapless_server.serve.adoption import waiting as module
from mapless_server.serve.adoption.keeping import Keeper
from mapless_server.serve.adoption.surveyed import Place, SurveyedLocalizer
from mapless_server.serve.adoption.waiting import MAX_WAITING, MAX_WAITING_BYTES, MOST_WAITING_S, Candidate, Waiting
from mapless_server.store import Store, adoption


def candidate(
    tenant: str = "one", size_bytes: int = 1, offered_s: float = 0.0, mask: bytes = b"", holder: str = ""
) -> Candidate:
    query = SimpleNamespace(scene_key=key_of(tenant, "room"), photo=SimpleNamespace(size_bytes=size_bytes, mask=mask))
    its, answered = cast(Query, query), cast(Evidence, None)
    return Candidate(its, its, answered, True, np.empty((0, 2)), 1.0, holder, offered_s)


def tenants(waiting: Waiting) -> list[str]:
    found = []
    while (it := waiting.pop()) is not None:
        found.append(it.tenant)
    return found


def test_one_tenant_cannot_fill_the_queue() -> None:
    waiting = Waiting()
    assert sum(waiting.add(candidate()) for _ in range(1000)) == 1000 - MAX_WAITING
    assert [waiting.add(candidate("two")) for _ in range(100)].count(1) == 100
    assert tenants(waiting) == ["one"] * (MAX_WAITING // 2) + ["two"] * (MAX_WAITING // 2)


def test_one_holder_leaves_room_for_others_of_its_tenant() -> None:
    """However many photographs come first; another tenant's share stays what it is."""
    waiting = Waiting()
    for _ in range(MAX_WAITING):
        waiting.add(candidate(holder="flood"))
    assert [waiting.add(candidate(holder="robot")) for _ in range(3)] == [1, 1, 1]
    for _ in range(MAX_WAITING):
        waiting.add(candidate("two", holder="flood"))
    assert waiting.add(candidate(holder="robot")) == 1
    left = [waiting.pop() for _ in range(MAX_WAITING)]
    assert [(it.tenant, it.holder) for it in left if it][-1] == ("one", "robot")
    counts = Counter((it.tenant, it.holder) for it in left if it)
    assert counts == {("one", "flood"): 12, ("one", "robot"): 4, ("two", "flood"): 16}


def test_what_has_no_room_pushes_out_nothing() -> None:
    waiting = Waiting()
    for _ in range(3):
        waiting.add(candidate(size_bytes=MAX_WAITING_BYTES // 3))
    assert waiting.add(candidate("two", MAX_WAITING_BYTES + 1)) == 1
    assert waiting.add(candidate("two", MAX_WAITING_BYTES)) == 1
    assert tenants(waiting) == ["one"] * 3


def test_large_photographs_make_room_for_another_tenant() -> None:
    waiting = Waiting()
    assert [waiting.add(candidate(size_bytes=MAX_WAITING_BYTES // 4)) for _ in range(5)] == [0, 0, 0, 0, 1]
    assert waiting.add(candidate("two", MAX_WAITING_BYTES // 2)) == 2
    assert waiting.add(candidate("two", MAX_WAITING_BYTES + 1)) == 1
    assert tenants(waiting) == ["one", "one", "two"]


def test_large_photographs_take_no_others_room() -> None:
    """Each tenant has half of the bytes, however few photographs those are."""
    waiting, part = Waiting(), MAX_WAITING_BYTES // 20
    assert [waiting.add(candidate("two", part)) for _ in range(10)] == [0] * 10
    assert [waiting.add(candidate(size_bytes=5 * part)) for _ in range(4)] == [0, 0, 1, 1]
    assert tenants(waiting) == ["two"] * 10 + ["one"] * 2


def test_what_has_waited_too_long_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting = Waiting()
    for offered_s in (0.0, 10.0):
        waiting.add(candidate(offered_s=offered_s))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: MOST_WAITING_S + 5.0))
    assert (waiting.drop_old(), len(waiting)) == (1, 1)


async def test_a_busy_server_deletes_what_is_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    busy = SimpleNamespace(queue=SimpleNamespace(job_count=1, busy_s=0.0))
    nobody = SimpleNamespace(count=lambda *_: None)
    its = adopter.Adopter(cast(QueueEngine, busy), cast(Store, None), cast(BackgroundObserver, nobody), 24.0)
    maintained: asyncio.Queue[None] = asyncio.Queue()
    monkeypatch.setattr(its, "maintain", lambda: maintained.put(None))
    monkeypatch.setattr(adopter, "MAINTAINED_S", 0.01)
    its._waiting.add(candidate(offered_s=time.monotonic()))
    running = asyncio.create_task(its.run())
    for _ in range(3):
        await asyncio.wait_for(maintained.get(), 10.0)
    assert len(its._waiting) == 1
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)


def test_computing_time_is_of_the_tenant_of_the_scene() -> None:
    assert SurveyedLocalizer.caller(key_of("two", "room")).flow.tenant == "two"


async def test_vouchers_are_looked_up_after_changes_only(monkeypatch: pytest.MonkeyPatch) -> None:
    room, asked = key_of("one", "room"), list[str]()
    generations = {room: 1}

    def looked_up(_: object, scene_key: str) -> list[str]:
        asked.append(scene_key)
        return []

    monkeypatch.setattr(adoption, "list_expired", lambda *_: [])
    monkeypatch.setattr(adoption, "list_adopting_scenes", lambda _: dict(generations))
    monkeypatch.setattr(adoption, "unvouched", looked_up)
    monkeypatch.setattr(adoption, "list_unplaced", lambda *_: [])
    monkeypatch.setattr(adoption, "list_outdated_scenes", lambda _: {})
    stored = cast(Store, SimpleNamespace(database=None))
    its = adopter.Adopter(cast(QueueEngine, None), stored, cast(BackgroundObserver, None), 24.0)
    for generation, count in ((1, 1), (1, 1), (2, 2)):
        generations[room] = generation
        await its.maintain()
        assert asked == [room] * count


async def test_masked_photographs_contradict_nothing() -> None:
    masked = candidate(mask=b"PNG")
    nobody = cast(BackgroundObserver, None), cast(SurveyedLocalizer, None)
    its = Keeper(cast(QueueEngine, None), cast(Store, None), *nobody, 24.0)
    nothing = cast(Result, None), datetime.now(timezone.utc), AdoptionOptions()
    await its.count_contradictions(masked, cast(Place, None), masked.answered, *nothing)  # asks no store
