"""What every call has: a limit, a deadline, a request id, and errors with what the caller may know."""

import time
from collections.abc import Iterator
from concurrent import futures
from pathlib import Path

import pytest
from support.servers import CAMERA, PHOTO, RunningServer, Stubs, failure_of, localize_request, pose, serving
from support.waiting import wait_until

from mapless import Client, ConnectOptions, DeadlineExceeded, LocalizationResult, NewReference, ResourceExhausted
from mapless.v1 import localization_service_pb2 as pb


@pytest.fixture
def pool() -> Iterator[futures.ThreadPoolExecutor]:
    with futures.ThreadPoolExecutor(64) as threads:
        yield threads


def test_a_full_queue_refuses_with_a_retry_delay(tmp_path: Path, pool: futures.ThreadPoolExecutor) -> None:
    with (
        serving(tmp_path, max_queued_s=2.0) as server,
        Client(server.address) as client,
        Client(server.address, ConnectOptions(max_attempts=1)) as impatient,
        server.method.held(),
    ):
        scene = client.create_scene("s").scene_id
        client.add_references(scene, [NewReference(f"r{i}", PHOTO, CAMERA, pose(i)) for i in range(3)])
        admitted = [pool.submit(client.localize, PHOTO, CAMERA, scene) for _ in range(2)]
        for _ in range(2):
            assert server.method.started.acquire(timeout=20)
        while True:  # further calls wait, until there is no room
            waiting = pool.submit(impatient.localize, PHOTO, CAMERA, scene)
            admitted.append(waiting)
            before = len(admitted)
            wait_until(lambda: waiting.done() or server.engine.queue.job_count == before)  # noqa: B023
            if waiting.done():
                admitted.pop()
                break
            assert before < 50
        start_s = time.monotonic()
        with pytest.raises(ResourceExhausted) as caught:
            waiting.result(0)
        assert time.monotonic() - start_s < 2
        assert caught.value.reason == "QUEUE_FULL"
        assert caught.value.retry_after_s is not None
        assert 0 < caught.value.retry_after_s < 60
        # The loop is free meanwhile: what needs no thread is answered.
        assert client.is_serving()
        assert client.get_scene(scene).reference_count == 3
        assert len(admitted) > 2
        server.method.gate.set()
        assert all(isinstance(future.result(30), LocalizationResult) for future in admitted)
    wait_until(lambda: server.engine.queue.job_count == 0)


def test_a_cancelled_call_is_not_computed(
    server: RunningServer, client: Client, scene: str, stubs: Stubs, pool: futures.ThreadPoolExecutor
) -> None:
    before = server.method.call_count
    with server.method.held():
        running = [pool.submit(client.localize, PHOTO, CAMERA, scene) for _ in range(2)]
        wait_until(lambda: server.method.call_count == before + 2)
        expires = pool.submit(client.localize, PHOTO, CAMERA, scene, timeout_s=2.0)
        cancelled = stubs.localization.Localize.future(localize_request(scene))
        wait_until(lambda: server.engine.queue.job_count == 4)
        with pytest.raises(DeadlineExceeded):
            expires.result(30)
        cancelled.cancel()
        wait_until(lambda: server.engine.queue.job_count == 2)
    for future in running:
        future.result(30)
    client.localize(PHOTO, CAMERA, scene)
    assert server.method.call_count == before + 3


@pytest.mark.parametrize("given", ["robot-7.frame_12", "x" * 64])
def test_a_request_id_is_taken_over(stubs: Stubs, scene: str, given: str) -> None:
    response, call = stubs.localization.Localize.with_call(
        localize_request(scene), metadata=[("x-request-id", given)], timeout=30
    )
    assert response.diagnostics.request_id == given
    assert dict(call.trailing_metadata())["x-request-id"] == given
    error = failure_of(stubs.localization.Localize, pb.LocalizeRequest(), metadata=[("x-request-id", given)])
    assert error.request_id == given


def test_a_message_over_the_limit(server: RunningServer, stubs: Stubs, client: Client, scene: str) -> None:
    request = localize_request(scene)
    request.image = bytes(33 * 2**20)
    assert failure_of(stubs.localization.Localize, request).code == "RESOURCE_EXHAUSTED"
    small = Client(server.address, ConnectOptions(max_message_mib=1, batch_mib=1))
    with small, pytest.raises(ResourceExhausted):
        small.localize(bytes(2 * 2**20), CAMERA, scene)
    client.localize(PHOTO, CAMERA, scene)
