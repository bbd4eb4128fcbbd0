"""The probe of the store answers in time, asks one question at a time, and asks again when its answer is old."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

from support.waiting import wait_until

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


def test_a_fault_is_one_line_and_ends_with_the_fault() -> None:
    faults = [ValueError("first\nsecond"), KeyError(), None]

    def check() -> None:
        if (fault := faults.pop(0)) is not None:
            raise fault

    probe = StoreProbe(check, kept_s=0.0)
    assert [probe.fault() for _ in range(3)] == ["first", "KeyError", ""]
