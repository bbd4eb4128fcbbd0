"""Streams in the clients: each better answer, retries of broken calls, errors last."""

import asyncio
import json
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from support.clients import Awaiting, hosted, status
from support.commands import run_client
from support.servers import CAMERA, PHOTO, pose

from mapless import (
    Client,
    ConnectOptions,
    Internal,
    InvalidArgument,
    LocalizationResult,
    MaplessError,
    Rejected,
    Unavailable,
    aio,
    wire,
)
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import (
    LocalizationServiceServicer,
    add_LocalizationServiceServicer_to_server,
)

FAST = ConnectOptions(max_attempts=4, timeout_s=20.0, initial_backoff_s=0.01, max_backoff_s=0.02)
LIMIT_S = 20.0

Attempt = tuple[Sequence[pb.LocalizeProgressivelyResponse], grpc.Status | None]
"""The messages of a call, and how it then fails."""


def localized(x_m: float, is_final: bool = False) -> pb.LocalizeProgressivelyResponse:
    stage = pb.POSE_STAGE_REFINED if is_final else pb.POSE_STAGE_COARSE
    found = pb.Localization(world_from_camera=wire.transform_to_message(pose(x_m)), pose_stage=stage)
    return pb.LocalizeProgressivelyResponse(answer=pb.LocalizeResponse(localization=found), is_final=is_final)


def rejected(is_final: bool = True) -> pb.LocalizeProgressivelyResponse:
    answer = pb.LocalizeResponse(rejection=pb.Rejection(reason=pb.REJECTION_REASON_GATE))
    return pb.LocalizeProgressivelyResponse(answer=answer, is_final=is_final)


COARSE, FINAL = localized(1.0), localized(2.0, is_final=True)


@dataclass
class Played(LocalizationServiceServicer):
    """Answers each call with the next attempt; the last is repeated.

    Attributes:
        attempts: these.
        left_s: to the deadline of each call that came.
        requests: what they asked.
        gone: set when a call ended that waits for ever, which one without messages and end does.
    """

    attempts: list[Attempt]
    left_s: list[float] = field(default_factory=list)
    requests: list[pb.LocalizeRequest] = field(default_factory=list)
    gone: threading.Event = field(default_factory=threading.Event)

    def LocalizeProgressively(  # noqa: N802
        self, request: pb.LocalizeRequest, context: grpc.ServicerContext
    ) -> Iterator[pb.LocalizeProgressivelyResponse]:
        self.left_s.append(context.time_remaining())
        self.requests.append(request)
        messages, end = self.attempts.pop(0) if len(self.attempts) > 1 else self.attempts[0]
        waits = end is None and not (messages and (messages[-1].is_final or len(messages) == 3))
        waits &= not (messages and messages[-1].answer.WhichOneof("outcome") != "localization")
        if waits:
            context.add_callback(self.gone.set)  # before the caller has read anything, and may go
        yield from messages
        if end is not None:
            context.abort_with_status(end)
        if waits:
            self.gone.wait(LIMIT_S)


@contextmanager
def playing(*attempts: Attempt) -> Iterator[tuple[str, Played]]:
    servicer = Played(list(attempts))
    with hosted(add=partial(add_LocalizationServiceServicer_to_server, servicer)) as address:
        try:
            yield address, servicer
        finally:
            servicer.gone.set()


@pytest.fixture(params=[Client, Awaiting], ids=["blocking", "asyncio"])
def kind(request: pytest.FixtureRequest) -> Any:
    return request.param


def ending_of(kind: Any, address: str, **asked: Any) -> tuple[list[LocalizationResult | Rejected], MaplessError | None]:
    """All that a call yields, and the error that it ends with."""
    answers: list[LocalizationResult | Rejected] = []

    async def collect(client: aio.Client) -> None:
        async for answer in client.localize_progressively(PHOTO, CAMERA, "s", **asked):
            answers.append(answer)  # noqa: PERF401  it may end by an error

    with kind(address, FAST) as client:
        try:
            if isinstance(client, Awaiting):
                client.wait(collect(client.client))
            else:
                for answer in client.localize_progressively(PHOTO, CAMERA, "s", **asked):
                    answers.append(answer)  # noqa: PERF402  it may end by an error
        except MaplessError as error:
            return answers, error
    return answers, None


def test_the_coarse_answer_is_printed_before_the_final_one(kind: Any) -> None:
    with playing(([COARSE, FINAL], None)) as (address, played):
        (first, last), error = ending_of(kind, address, variant="full", axes="unity")
    assert error is None
    assert isinstance(first, LocalizationResult)
    assert isinstance(last, LocalizationResult)
    assert (first.pose_stage, first.is_final, last.pose_stage, last.is_final) == ("COARSE", False, "REFINED", True)
    np.testing.assert_allclose(first.world_from_camera.translation, pose(1.0).translation)
    np.testing.assert_allclose(last.world_from_camera.translation, pose(2.0).translation)
    (request,) = played.requests
    assert (request.scene, request.image) == ("scenes/s", PHOTO)
    assert (request.options.variant, request.options.axes) == (pb.VARIANT_FULL, pb.AXES_UNITY)


BROKEN, FULL = status("UNAVAILABLE"), status("RESOURCE_EXHAUSTED", retry_after_s=0.01)


@pytest.mark.parametrize(
    ("attempts", "expected_m"),
    [
        ([([FINAL], None)], [2.0]),
        ([([], BROKEN), ([], FULL), ([COARSE, FINAL], None)], [1.0, 2.0]),
        ([([COARSE, localized(1.5), localized(1.75), FINAL], None)], [1.0, 1.5, 1.75, 2.0]),
        ([([COARSE], BROKEN), ([localized(5.0), FINAL], None)], [1.0, 2.0]),
        ([([COARSE, localized(1.5)], BROKEN), ([localized(5.0), localized(6.0), FINAL], None)], [1.0, 1.5, 2.0]),
        ([([COARSE], BROKEN), ([], BROKEN), ([FINAL], None)], [1.0, 2.0]),
        ([([COARSE, FINAL], BROKEN)], [1.0, 2.0]),
    ],
    ids=["one", "before the first", "several", "after it", "after several", "after it and again", "when all is said"],
)
def test_a_broken_call_that_gave_answers_gives_only_the_last(
    kind: Any, attempts: list[Attempt], expected_m: list[float]
) -> None:
    with playing(*attempts) as (address, played):
        answers, error = ending_of(kind, address)
    assert error is None
    assert [it.world_from_camera.translation[0] for it in answers if isinstance(it, LocalizationResult)] == expected_m
    assert [it.is_final for it in answers] == [False] * (len(expected_m) - 1) + [True]
    assert len(played.left_s) == len(attempts)


@pytest.mark.parametrize(
    ("end", "error_type", "tries"),
    [(status("INVALID_ARGUMENT"), InvalidArgument, 1), (BROKEN, Unavailable, FAST.max_attempts)],
)
@pytest.mark.parametrize("messages", [[], [COARSE]], ids=["before", "after"])
def test_an_error_comes_last(
    kind: Any,
    messages: list[pb.LocalizeProgressivelyResponse],
    end: grpc.Status,
    error_type: type[MaplessError],
    tries: int,
) -> None:
    with playing((messages, end)) as (address, played):
        answers, error = ending_of(kind, address)
    assert type(error) is error_type
    assert len(answers) == len(messages)
    assert len(played.left_s) == tries


def test_the_deadline_is_that_of_all(kind: Any) -> None:
    later = status("RESOURCE_EXHAUSTED", retry_after_s=0.3)
    with playing(([], later), ([COARSE], None)) as (address, played):
        answers, error = ending_of(kind, address, timeout_s=1.0)
    assert error is not None
    assert (len(answers), error.code) == (1, "DEADLINE_EXCEEDED")
    first_s, second_s = played.left_s
    assert second_s < 0.75 < first_s < 1.05


@pytest.mark.parametrize(
    "messages",
    [[COARSE, COARSE, COARSE], [rejected(is_final=False)], [pb.LocalizeProgressivelyResponse()]],
    ids=["no end", "a rejection first", "nothing"],
)
def test_what_breaks_the_contract_is_the_servers_fault(
    kind: Any, messages: list[pb.LocalizeProgressivelyResponse]
) -> None:
    with playing((messages, None)) as (address, _):
        answers, error = ending_of(kind, address)
    assert isinstance(error, Internal)
    assert error.reason == "MALFORMED_ANSWER"
    assert len(answers) == (len(messages) if len(messages) == 3 else 0)


def test_a_reader_that_stops_ends_the_call() -> None:
    with playing(([COARSE], None)) as (address, played), Client(address, FAST) as client:
        answers = client.localize_progressively(PHOTO, CAMERA, "s")
        assert not next(answers).is_final
        assert not played.gone.is_set()
        answers.close()  # type: ignore[attr-defined]  # it is a generator
        assert played.gone.wait(LIMIT_S)


def test_a_reader_that_stops_ends_the_call_in_asyncio() -> None:
    async def read_one(address: str) -> None:
        async with aio.Client(address, FAST) as client:
            answers = client.localize_progressively(PHOTO, CAMERA, "s")
            assert not (await anext(answers)).is_final
            await answers.aclose()  # type: ignore[attr-defined]  # it is a generator

    with playing(([COARSE], None)) as (address, played):
        asyncio.run(read_one(address))
        assert played.gone.wait(LIMIT_S)


CAMERA_NUMBERS = "80,81,47.5,31.5"


def command(capsys: pytest.CaptureFixture[str], address: str, *arguments: str) -> tuple[int, list[str], str]:
    """Exit code, lines printed, and the error output."""
    flags = ("--camera", CAMERA_NUMBERS, "--progressive")
    code, printed, error = run_client(capsys, "--address", address, "localize", "s", *arguments, *flags)
    return code, printed.splitlines(), error


@pytest.fixture
def photo(tmp_path: Path) -> str:
    path = tmp_path / "photo.png"
    path.write_bytes(PHOTO)
    return str(path)


@pytest.mark.parametrize(("last", "code"), [(FINAL, 0), (rejected(), 3)], ids=["localized", "rejected"])
def test_the_command_prints_a_line_for_each_answer(
    capsys: pytest.CaptureFixture[str], photo: str, last: pb.LocalizeProgressivelyResponse, code: int
) -> None:
    with playing(([COARSE, last], None)) as (address, _):
        exit_code, lines, _ = command(capsys, address, photo)
    assert exit_code == code
    assert [json.loads(line)["is_final"] for line in lines] == [False, True]


def test_output_labels_the_coarse_and_the_final_answer(
    capsys: pytest.CaptureFixture[str], photo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    with playing(([COARSE, FINAL], None)) as (address, _):
        exit_code, lines, _ = command(capsys, address, photo)
    assert exit_code == 0
    assert [line for line in lines if line[0] != " "] == ["coarse pose; the final answer follows", "localized"]


def test_what_fails_leaves_no_file_and_a_folder_is_refused(
    capsys: pytest.CaptureFixture[str], photo: str, tmp_path: Path
) -> None:
    with playing(([], status("INVALID_ARGUMENT"))) as (address, _):
        assert command(capsys, address, photo, "--output", str(tmp_path / "answers.json"))[0] == 1
        assert not (tmp_path / "answers.json").exists()
        exit_code, _, error_text = command(capsys, address, str(tmp_path))
    assert exit_code == 2
    assert "--progressive takes one photograph, not a folder" in error_text
