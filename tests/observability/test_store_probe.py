"""The probe of the store answers in time, asks one question at a time, and asks again when its answer is old."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.waiting import wait_until

from mapless_server.errors import Unavailable
from mapless_server.observability.store_probe import StoreProbe


def test_a_store_that_hangs_is_asked_once_by_many_probes() -> None:
    goes_on, asked = threading.Event(), []

    def check() -> None:
        asked.append(1)
        assert goes_on.wait(30)

    probe = StoreProbe(check, limit_s=0.3, kept_s=0.0)
    with ThreadPoolExecutor(8) as pool:
        start_s = time.monotonic()
        faults = [it.result(30) for it in [pool.submit(probe.fault) for _ in range(40)]]
        assert time.monotonic() - start_s < 5.0  # 40 probes one after the other would take 12
    assert set(faults) == {"the store does not answer"}
    assert len(asked) == 1
    assert sum(thread.name == "store-probe" for thread in threading.enumerate()) == 1
    goes_on.set()
    wait_until(lambda: probe.fault() == "")
    assert len(asked) > 1


def test_an_answer_is_kept_for_its_time() -> None:
    asked = []
    probe = StoreProbe(lambda: asked.append(1), kept_s=60.0)
    assert [probe.fault() for _ in range(5)] == [""] * 5
    assert len(asked) == 1


def test_what_the_database_says_is_for_the_log_alone(caplog: pytest.LogCaptureFixture) -> None:
    """Once for each fault, however often it is asked for."""
    secret = ValueError('connection to "10.1.2.3", user "mapless" failed\npassword')
    faults = [secret, secret, KeyError(), Unavailable("the store is busy"), None, secret]

    def check() -> None:
        if (fault := faults.pop(0)) is not None:
            raise fault

    probe = StoreProbe(check, kept_s=0.0)
    found = [probe.fault() for _ in range(6)]
    away = "the store is away"
    assert found == [away, away, away, "the store is busy", "", away]
    assert caplog.text.count("10.1.2.3") >= 2
    assert len(caplog.records) == 3
