"""A folder of photographs and a server that has no room for all at once, fails, or goes away."""

import json
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import grpc
import pytest
from google.rpc import error_details_pb2, status_pb2
from support.clients import hosted
from support.commands import run_client
from support.planted_answers import diagnostics, localized, rejected

from mapless import wire
from mapless.cli import localize
from mapless.cli.folder import Concurrency, Tally
from mapless.errors import InvalidArgument, ResourceExhausted
from mapless.geometry import RigidTransform
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import (
    LocalizationServiceServicer,
    add_LocalizationServiceServicer_to_server,
)

COUNT = 8
ANSWER = pb.LocalizeResponse(
    localization=pb.Localization(
        world_from_camera=wire.transform_to_message(RigidTransform.identity()), pose_stage=pb.POSE_STAGE_REFINED
    )
)
REJECTION = pb.LocalizeResponse(rejection=pb.Rejection(reason=pb.REJECTION_REASON_LOW_OVERLAP))
Fault = Callable[[str, grpc.ServicerContext], "pb.LocalizeResponse | None"]
"""The outcome of a photograph by its name, None for a pose."""


@dataclass
class FewAtATime(LocalizationServiceServicer):
    """Takes so many calls at a time, and refuses the others until there is room, the first when so many have come."""

    room: int = COUNT
    first: int = 1
    came: int = 0
    fault: Fault = lambda name, context: None
    address: str = ""
    running: int = 0
    answered: list[str] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def Localize(self, request: pb.LocalizeRequest, context: grpc.ServicerContext) -> pb.LocalizeResponse:  # noqa: N802
        name = request.image.decode()
        with self.changed:
            self.came += 1
            self.changed.notify_all()
            if self.running == self.room:
                self.changed.wait_for(lambda: self.came >= self.first, 20)
                self.refused[name] += 1
                self.changed.notify_all()
                refuse(context)
            self.running += 1
        try:
            answer = self.fault(name, context)
            with self.changed:
                self.answered.append(name)
            return answer or ANSWER
        finally:
            with self.changed:
                self.running -= 1


def refuse(context: grpc.ServicerContext) -> None:
    status = status_pb2.Status(code=grpc.StatusCode.RESOURCE_EXHAUSTED.value[0])
    status.details.add().Pack(error_details_pb2.ErrorInfo(reason="QUEUE_FULL"))
    soon = error_details_pb2.RetryInfo()
    soon.retry_delay.FromNanoseconds(1)
    status.details.add().Pack(soon)
    context.set_trailing_metadata((("grpc-status-details-bin", status.SerializeToString()),))
    context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, "full")


@pytest.fixture
def server() -> Iterator[FewAtATime]:
    service = FewAtATime()
    with hosted(add=partial(add_LocalizationServiceServicer_to_server, service), threads=2 * COUNT) as service.address:
        yield service


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Photographs that hold their own names."""
    k = [[80.0, 0, 47.5], [0, 81.0, 31.5], [0, 0, 1]]
    frames = [{"image": f"{i}.jpg", "width": 96, "height": 64, "K": k} for i in range(COUNT)]
    (tmp_path / "cameras.json").write_text(json.dumps({"frames": frames}))
    for i in range(COUNT):
        (tmp_path / f"{i}.jpg").write_text(f"{i}")
    return tmp_path


def run(
    server: FewAtATime, folder: Path, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[Any, list[Any], str]:
    """Exit code, answers, and what was said of them."""
    code, printed, error = run_client(capsys, "localize", "s", folder, "--address", server.address, *arguments)
    return code, [json.loads(line) for line in printed.splitlines()], error


def test_refused_photographs_do_not_wait_behind_new_ones(
    server: FewAtATime, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of four at a time is taken, and answered when each of the others was refused and has come again."""
    server.room, server.first = 1, 4  # a refusal before would make the client send fewer at a time

    def until_all_came_again(name: str, context: grpc.ServicerContext) -> None:
        if not server.answered:
            with server.changed:
                server.changed.wait_for(lambda: sum(count >= 2 for count in server.refused.values()) == 3, 20)

    server.fault = until_all_came_again
    code, answers, report = run(server, folder, capsys, "--parallel", "4")
    assert (code, report) == (0, f"{COUNT} of {COUNT} localized\n")
    assert [answer["photo"] for answer in answers] == [f"{i}.jpg" for i in range(COUNT)]
    assert set(server.answered[:3]) < {"0", "1", "2", "3"}


def test_the_summary_counts_the_reasons(server: FewAtATime, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def fault(name: str, context: grpc.ServicerContext) -> pb.LocalizeResponse | None:
        if name in {"1", "4"}:
            context.abort(grpc.StatusCode.INTERNAL, "broken")
        if name == "2":
            return REJECTION
        return None

    server.fault = fault
    (folder / "5.jpg").unlink()
    code, answers, report = run(server, folder, capsys)
    summary = f"4 of {COUNT} localized, 1 not localized (1 LOW_OVERLAP), 3 failed (2 INTERNAL, 1 UNREADABLE_FILE)\n"
    assert (code, report) == (1, summary)
    assert "5.jpg cannot be read: No such file" in answers[5]["error"]["message"]


def test_an_interrupted_run_reports_its_progress(
    server: FewAtATime, folder: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def fault(name: str, context: grpc.ServicerContext) -> None:
        if name == "3":
            context.abort(grpc.StatusCode.NOT_FOUND, "no such scene")

    server.fault = fault
    written = tmp_path / "poses.jsonl"
    code, _, report = run(server, folder, capsys, "--output", str(written), "--parallel", "1")
    where = f"answers are in {written}\n"
    assert (code, report) == (
        1,
        f"ended after 3 of {COUNT}: 3 of 3 localized\n{where}mapless: NOT_FOUND: no such scene\n",
    )
    assert len(written.read_text().splitlines()) == 3


def test_an_interruption_ends_the_calls_in_flight(
    server: FewAtATime, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hung_up, is_waiting, has_waited = threading.Event(), threading.Event(), threading.Event()

    def fault(name: str, context: grpc.ServicerContext) -> None:
        if name != "0":
            context.add_callback(hung_up.set)
            is_waiting.set()
            if not hung_up.wait(8):
                has_waited.set()

    def interrupted(*_: Any) -> NoReturn:
        assert is_waiting.wait(20)
        raise KeyboardInterrupt

    server.fault = fault
    monkeypatch.setattr(localize, "_row", interrupted)
    code, _, _ = run(server, folder, capsys)
    assert (code, hung_up.wait(20), has_waited.is_set()) == (130, True, False)


def test_what_is_captured_is_counted() -> None:
    captured = replace(diagnostics(), captured=True)
    tally = Tally(4)
    for outcome in (
        localized(diagnostics=captured),
        rejected(diagnostics=captured),
        localized(),
        InvalidArgument("INVALID_ARGUMENT", "no image", reason="INVALID_IMAGE"),
    ):
        tally.count(outcome)
    report = "2 of 4 localized, 1 not localized (1 LOW_OVERLAP), 1 failed (1 INVALID_IMAGE); 2 captured by the server"
    assert (tally.summary(), tally.exit_code) == (report, 1)


def test_refusals_lower_concurrency_and_answers_raise_it() -> None:
    concurrency = Concurrency(2)
    for _ in range(5):
        concurrency.failed(ResourceExhausted("RESOURCE_EXHAUSTED", "full"))
    with concurrency.call():
        pass
    with concurrency.call(), concurrency.call():  # would block for ever at a limit of one
        pass
