"""LocalizeProgressively through a real server: the order of messages, their content, and how a stream ends."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from support.compare import assert_pose_close
from support.corner import CAMERA as CORNER_CAMERA
from support.corner import make_corner, photograph
from support.corner import pose as corner_pose
from support.messages import essence
from support.servers import (
    COARSE_X_M,
    RunningServer,
    Staged,
    ending,
    localize_request,
    make_scene,
    pose,
    serving,
    serving_really,
)
from support.waiting import wait_until, with_enough_time

from mapless import Client, MaplessError, RigidTransform, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub

LIMIT_S = 30.0


@dataclass
class Serving:
    """A running server, what its method does, and a stub for it."""

    server: RunningServer
    method: Staged
    stub: LocalizationServiceStub

    @property
    def job_count(self) -> int:
        """How many calls are in the queue or computed."""
        return self.server.engine.queue.job_count


@contextmanager
def staged(data_dir: Path, features: Sequence[str] = ("stand-in",), **options: Any) -> Iterator[Serving]:
    """A server with a scene "s" of three references, whose method refines when it is let."""
    method = Staged()
    with (
        serving(data_dir, features, method=method.method(), **({"workers": 1} | options)) as server,
        grpc.insecure_channel(server.address) as channel,
    ):
        with Client(server.address) as client:
            make_scene(client, count=3)
        try:
            yield Serving(server, method, LocalizationServiceStub(channel))
        finally:
            method.gate.set()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with staged(tmp_path_factory.mktemp("data"), allow_watching=True) as running:
        yield running


@pytest.fixture
def server(shared: Serving) -> Iterator[Serving]:
    shared.method.reset()
    yield shared
    shared.method.gate.set()
    wait_until(lambda: shared.job_count == 0)


def asking(
    server: Serving, timeout: float | None = LIMIT_S, metadata: Any = (), allow_coarse: bool = True, **fields: Any
) -> Any:
    request = localize_request("s")
    request.options.allow_coarse = allow_coarse
    request.MergeFrom(pb.LocalizeRequest(**fields))
    return server.stub.LocalizeProgressively(request, timeout=timeout, metadata=metadata)


def test_the_coarse_pose_comes_first_with_only_what_is_known(server: Serving) -> None:
    session = wire.transform_to_message(pose(3.0))
    asked: dict[str, Any] = {"session_from_camera": session, "options": pb.LocalizeOptions(axes=pb.AXES_UNITY)}
    call = asking(server, **asked, metadata=(("x-request-id", "mine"),))
    first = next(call)
    assert server.method.refining.acquire(timeout=LIMIT_S)
    assert server.job_count == 1
    found = first.answer.localization
    assert not first.is_final
    assert found.pose_stage == pb.POSE_STAGE_COARSE
    assert not any(found.HasField(it) for it in ("covariance", "accuracy", "trust"))
    assert (found.inlier_count, found.match_count, len(found.prior_checks)) == (0, 0, 0)
    assert not first.answer.HasField("debug")
    assert_pose_close(
        wire.transform_from_message(found.world_from_camera, ""), pose(COARSE_X_M), metres=1e-9, degrees=1e-6
    )
    assert found.in_axes.HasField("world_from_session")
    assert first.answer.session_from_camera == session
    assert first.answer.diagnostics.request_id == "mine"
    assert [it.stage for it in first.answer.diagnostics.stages][-1] == "coarse"
    server.method.gate.set()
    last = next(call)
    assert last.is_final
    assert last.answer.localization.pose_stage == pb.POSE_STAGE_REFINED
    refined = wire.transform_from_message(last.answer.localization.world_from_camera, "")
    assert_pose_close(refined, pose(0), metres=1e-9, degrees=1e-6)
    assert list(call) == []
    assert call.code() is grpc.StatusCode.OK
    assert dict(call.trailing_metadata())["x-request-id"] == "mine"


ANGLES_DEG = (-24, -16, -8, 0, 8, 16, 24)


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalizationServiceStub]:
    """A server as it is shipped, with a scene of a papered corner."""
    with serving_really(tmp_path_factory.mktemp("corner"), workers=1) as server, Client(server.address) as client:
        make_corner(client, [corner_pose(angle) for angle in ANGLES_DEG], "s")
        with grpc.insecure_channel(server.address) as channel:
            yield LocalizationServiceStub(channel)


def corner_request(world_from_camera: RigidTransform, **options: Any) -> pb.LocalizeRequest:
    return pb.LocalizeRequest(
        scene="scenes/s",
        image=photograph(world_from_camera),
        intrinsics=wire.camera_to_message(CORNER_CAMERA),
        options=pb.LocalizeOptions(**options),
    )


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({}, 1),
        ({"allow_coarse": True}, 2),
        ({"axes": pb.AXES_ROS, "include_debug": True, "allow_coarse": True}, 2),
        ({"variant": pb.VARIANT_FULL, "reference_count": 4, "allow_coarse": True}, 2),
        ({"variant": pb.VARIANT_COARSE, "allow_coarse": True}, 1),
    ],
    ids=["default", "coarse first", "all that can be asked for", "the paper's", "coarse alone"],
)
def test_the_last_message_is_what_localize_answers_bit_for_bit(
    corner: LocalizationServiceStub, options: dict[str, Any], count: int
) -> None:
    truth = corner_pose(3.0, -1.4)
    request = corner_request(truth, **options)
    plain = corner.Localize(request, timeout=LIMIT_S)
    messages = list(corner.LocalizeProgressively(request, timeout=LIMIT_S))
    assert [it.is_final for it in messages] == [False] * (count - 1) + [True]
    assert essence(messages[-1].answer, True) == essence(plain, True)
    assert plain.WhichOneof("outcome") == "localization"
    for message in messages:
        found = wire.transform_from_message(message.answer.localization.world_from_camera, "")
        assert np.linalg.norm(found.translation - truth.translation) < 0.02


@pytest.mark.parametrize("coarse", [None, RigidTransform(np.eye(3), np.full(3, np.nan))], ids=["none", "not finite"])
def test_without_a_coarse_pose_only_the_answer_is_sent(server: Serving, coarse: RigidTransform | None) -> None:
    server.method.coarse = coarse
    server.method.gate.set()
    (only,) = asking(server)
    assert only.is_final


def test_a_coarse_pose_outside_a_hard_limit_is_not_sent(server: Serving) -> None:
    server.method.gate.set()
    near = pb.PositionPrior(position_m=wire.transform_to_message(pose(0)).translation_m, radius_m=2.5)
    (only,) = asking(server, position_prior=near)
    assert only.is_final
    assert only.answer.WhichOneof("outcome") == "localization"


def test_a_cancelled_stream_frees_its_place_and_ends_refining(server: Serving) -> None:
    before = server.server.value("mapless_jobs_terminated_total", outcome="cancelled", stage="refine")
    call = asking(server)
    next(call)
    assert server.method.refining.acquire(timeout=LIMIT_S)
    call.cancel()
    assert server.method.given_up.acquire(timeout=LIMIT_S)
    wait_until(lambda: server.job_count == 0)
    assert server.server.value("mapless_jobs_terminated_total", outcome="cancelled", stage="refine") == before + 1
    server.method.gate.set()
    assert len(list(asking(server))) == 2


def test_a_deadline_before_any_pose_is_a_detailed_error(server: Serving) -> None:
    def asked(limit_s: float) -> MaplessError:
        failure = ending(asking(server, limit_s, allow_coarse=False))
        if not failure.request_id or not server.method.refining.acquire(blocking=False):
            raise TimeoutError  # a busy machine answers too late, or begins too late
        return failure

    failure = with_enough_time(asked, grpc.RpcError, TimeoutError)
    assert (failure.code, failure.reason) == ("DEADLINE_EXCEEDED", "DEADLINE_EXCEEDED")
    assert server.method.given_up.acquire(timeout=LIMIT_S)


def test_where_a_coarse_pose_suffices_the_deadline_ends_it(server: Serving) -> None:
    first, last = with_enough_time(lambda limit_s: list(asking(server, limit_s)), grpc.RpcError)
    assert (first.is_final, last.is_final) == (False, True)
    assert last.answer.localization == first.answer.localization
    assert last.answer.localization.pose_stage == pb.POSE_STAGE_COARSE


def test_watchers_see_the_answer_once_and_it_counts_once(server: Serving) -> None:
    answered = server.server.value("mapless_answers_total", outcome="localized")
    seen = server.stub.WatchQueries(pb.WatchQueriesRequest(scene="scenes/s"), timeout=LIMIT_S)
    seen.initial_metadata()
    server.method.gate.set()
    for name in ("first", "second"):
        assert len(list(asking(server, metadata=(("x-request-id", name),)))) == 2
    shown = [next(seen) for _ in range(2)]
    assert [it.answer.diagnostics.request_id for it in shown] == ["first", "second"]
    assert [it.answer.localization.pose_stage for it in shown] == [pb.POSE_STAGE_REFINED] * 2
    assert server.server.value("mapless_answers_total", outcome="localized") == answered + 2
    seen.cancel()


@pytest.fixture
def doubting(tmp_path: Path) -> Iterator[Serving]:
    """A server of two tiers, whose answers are doubtful, so that the stronger features try again."""
    with staged(tmp_path, features=("cheap", "strong")) as both:
        both.method.trust = 0.01
        both.method.gate.set()
        yield both


@pytest.mark.parametrize("allow_coarse", [True, False])
def test_an_accepted_answer_is_sent_while_a_better_one_is_sought(doubting: Serving, allow_coarse: bool) -> None:
    messages = list(asking(doubting, allow_coarse=allow_coarse))
    coarse, refined = pb.POSE_STAGE_COARSE, pb.POSE_STAGE_REFINED
    expected = [("cheap", refined, False), ("strong", refined, True)]
    assert [(it.answer.diagnostics.features, it.answer.localization.pose_stage, it.is_final) for it in messages] == [
        *([("cheap", coarse, False)] if allow_coarse else []),
        *expected,
    ]
    accepted = messages[-2].answer.localization
    assert accepted.HasField("covariance")
    assert accepted.trust == pytest.approx(0.01)


def logged_fields(caplog: pytest.LogCaptureFixture) -> list[dict[str, Any]]:
    """Those of the ended calls. They are written behind the answers, so that earlier tests' may be among them."""
    return [vars(it)["fields"] for it in caplog.records if "fields" in vars(it)]


def test_the_log_has_the_time_of_the_first_answer(server: Serving, caplog: pytest.LogCaptureFixture) -> None:
    counted = server.server.value("mapless_early_answer_seconds_count")
    with caplog.at_level("INFO", "mapless_server.rpc.guard"):
        call = asking(server, metadata=(("x-request-id", "logged"),))
        next(call)
        server.method.gate.set()
        assert len(list(call)) == 1
        wait_until(lambda: any(it["request_id"] == "logged" for it in logged_fields(caplog)))
    (fields,) = (it for it in logged_fields(caplog) if it["request_id"] == "logged")
    assert 0 < fields["first_ms"] <= fields["duration_ms"]
    assert server.server.value("mapless_early_answer_seconds_count") == counted + 1
    assert {"prepare", "coarse", "refine"} == set(fields["stages_ms"])
    assert (fields["outcome"], fields["pose_stage"], fields["code"]) == ("localized", "refined", "OK")
    assert fields["bytes_out"] > 0
