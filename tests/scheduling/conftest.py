"""No exception may reach only the event loop, and what is counted for jobs ends with them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import pytest

from mapless_server.scheduling.admission import Ledger


@pytest.fixture(autouse=True)
def _nothing_unhandled(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """An exception that reaches only the loop is a failure."""
    yield
    logged = [*caplog.get_records("call"), *caplog.get_records("teardown")]
    assert not [it for it in logged if it.name == "asyncio" and it.levelname == "ERROR"]


@pytest.fixture(autouse=True)
def _every_job_is_counted_once(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """At the end of a test, those that are left are counted; once they have ended, too, none is."""
    ledgers, make = list[Ledger](), Ledger.__init__

    def remembered(ledger: Ledger, *args: object) -> None:
        make(ledger, *args)  # type: ignore[arg-type]
        ledgers.append(ledger)

    monkeypatch.setattr(Ledger, "__init__", remembered)
    yield
    for ledger in ledgers:
        for job in list(ledger.jobs):
            if job in ledger._aside:
                ledger.resume(job, Counter())
        assert ledger.job_count() == len(ledger.jobs)
        for job in list(ledger.jobs):
            ledger.close(job)
        assert (ledger.job_count(), sum(ledger._all.booked_s.values())) == (0, 0)
