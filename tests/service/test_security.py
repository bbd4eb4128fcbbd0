"""Callers without a valid token or certificate, of another tenant, or over their rate, at a real server."""

import json
import logging
import time
from collections.abc import Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from support.certificates import authority, options_of, signed
from support.servers import CAMERA, PHOTO, localize_request, pose, serving
from support.tokened import LIMIT_S, REFERENCE_SERVICE, Guarded, requests_of_all, requests_on
from support.waiting import wait_until

from mapless import (
    Client,
    ConnectOptions,
    LocalizationResult,
    NewReference,
    NotFound,
    Reference,
    ResourceExhausted,
    Unauthenticated,
    Unavailable,
)
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless_server.security import METHOD_ROLES, create_token, revoke_token, sha256_of

EXPIRED = "mapless_expired"
CALLERS = {
    "reader": ("acme", "read"),
    "robot": ("acme", "localize"),
    "writer": ("acme", "write"),
    "stranger": ("other", "write"),
    "local": ("default", "write"),
}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    folder = tmp_path_factory.mktemp("guarded")
    tokens_file = folder / "tokens.json"
    over = (datetime.now(timezone.utc) - timedelta(seconds=1)).isoformat()
    old = {"name": "old", "tenant": "acme", "role": "write", "sha256": sha256_of(EXPIRED), "expires": over}
    tokens_file.write_text(json.dumps({"tokens": [old]}))
    tokens = {caller: create_token(tokens_file, caller, *held, None) for caller, held in CALLERS.items()}
    with serving(folder / "data", tokens_file=tokens_file, allow_watching=True) as server:
        guarded = Guarded(server, tokens, tokens_file)
        for caller, x_m in (("writer", 1.0), ("stranger", 2.0), ("local", 3.0)):
            with guarded.client(caller) as client:
                client.create_scene("shared")
                client.add_references("shared", [NewReference("r", PHOTO, CAMERA, pose(x_m))])
        with guarded.client("writer") as client:
            client.create_scene("secret")
            client.add_references("secret", [NewReference("r", PHOTO, CAMERA, pose(0.0))])
        yield guarded


ALL_REQUESTS = requests_of_all("shared")


def test_every_method_is_tried() -> None:
    assert set(ALL_REQUESTS) == set(METHOD_ROLES)


@pytest.mark.parametrize(
    ("method", "token", "reason"),
    [
        *((method, None, "TOKEN_MISSING") for method in sorted(METHOD_ROLES)),
        (REFERENCE_SERVICE + "GetScene", "mapless_wrong", "TOKEN_INVALID"),
        (REFERENCE_SERVICE + "GetScene", EXPIRED, "TOKEN_EXPIRED"),
    ],
)
def test_without_a_good_token_no_method_answers(guarded: Guarded, method: str, token: str | None, reason: str) -> None:
    failure = guarded.failure(method, ALL_REQUESTS[method], token)
    assert isinstance(failure, Unauthenticated)
    assert failure.reason == reason
    assert failure.request_id


def test_health_and_the_interface_are_open(guarded: Guarded) -> None:
    with guarded.client(None) as client:
        assert client.is_serving()
        with pytest.raises(Unauthenticated):
            next(client.list_scenes())
    with grpc.insecure_channel(guarded.server.address) as channel:
        stub = reflection_pb2_grpc.ServerReflectionStub(channel)
        question = reflection_pb2.ServerReflectionRequest(list_services="")
        (answer,) = stub.ServerReflectionInfo(iter([question]), timeout=LIMIT_S)
        assert "mapless.v1.ReferenceService" in {it.name for it in answer.list_services_response.service}


@pytest.mark.parametrize("method", sorted(requests_on("secret")))
def test_a_scene_of_another_tenant_is_not_there_in_any_method(guarded: Guarded, method: str) -> None:
    for stranger in ("stranger", "local"):
        failures = []
        for scene_id in ("secret", "absent"):
            failure = guarded.failure(method, requests_on(scene_id)[method], guarded.tokens[stranger])
            assert isinstance(failure, NotFound)
            failures.append((str(failure).replace(scene_id, "..."), failure.reason, failure.field))
        assert failures[0] == failures[1]
        assert "acme" not in failures[0][0]
    with guarded.client("writer") as client:
        assert client.get_scene("secret").reference_count == 1


def test_each_tenant_has_its_own_scene_under_the_same_name(guarded: Guarded) -> None:
    theirs = (("writer", 1.0, ["secret", "shared"]), ("stranger", 2.0, ["shared"]), ("local", 3.0, ["shared"]))
    for caller, x_m, scenes in theirs:
        with guarded.client(caller) as client:
            assert [scene.scene_id for scene in client.list_scenes(page_size=1)] == scenes
            (reference,) = client.list_references("shared", page_size=1)
            assert isinstance(reference, Reference)
            assert (reference.scene_id, reference.reference_id) == ("shared", "r")
            for named in ([], ["r"]):
                answer = client.localize(PHOTO, CAMERA, "shared", named)
                assert isinstance(answer, LocalizationResult)
                assert answer.world_from_camera.translation[0] == pytest.approx(x_m)
    with guarded.client("robot") as client:
        assert isinstance(client.localize(PHOTO, CAMERA, "secret"), LocalizationResult)
    answer = localization_pb.LocalizeResponse.FromString(
        guarded.call("/mapless.v1.LocalizationService/Localize", localize_request("shared"), guarded.tokens["robot"])
    )
    assert [it.name for it in answer.diagnostics.references] == ["scenes/shared/references/r"]
    assert "acme" not in str(answer)


def test_a_token_that_is_made_or_revoked_while_the_server_runs(guarded: Guarded) -> None:
    token = create_token(guarded.tokens_file, "passing", "acme", "read", None)

    def is_known() -> bool:
        try:
            with guarded.client(token) as client:
                return client.get_scene("secret").scene_id == "secret"
        except Unauthenticated:
            return False

    wait_until(is_known)
    revoke_token(guarded.tokens_file, "passing")
    wait_until(lambda: not is_known())
    with guarded.client("reader") as client:
        assert client.get_scene("secret").scene_id == "secret"


def test_the_log_names_the_caller_and_shows_no_token(guarded: Guarded, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG), guarded.client("reader") as client:
        client.get_scene("secret")
        with pytest.raises(Unauthenticated), guarded.client("mapless_wrong") as unknown:
            unknown.get_scene("secret")
    logged = "\n".join(f"{record.getMessage()} {record.__dict__}" for record in caplog.records)
    assert "reader" in logged
    assert guarded.tokens["reader"] not in logged
    assert "mapless_wrong" not in logged


def test_a_tenant_over_its_rate_waits_and_others_do_not(tmp_path: Path) -> None:
    tokens_file = tmp_path / "tokens.json"
    tokens_file.write_text('{"tenants": {"acme": {"rate_ms": 0.001}}}')
    tokens = {tenant: create_token(tokens_file, tenant, tenant, "write", None) for tenant in ("acme", "other")}
    with serving(tmp_path / "data", tokens_file=tokens_file, tenant_burst_ms=1) as server:
        for tenant, token in tokens.items():
            options = ConnectOptions(timeout_s=LIMIT_S, max_attempts=1, token=token)
            with Client(server.address, options) as client:
                client.create_scene("s")
                refusals = [it for it in (refusal_of_upload(client, f"r{i}") for i in range(3)) if it]
            assert bool(refusals) == (tenant == "acme")
            for refusal in refusals:
                assert refusal.retry_after_s is not None
                assert refusal.retry_after_s > 0


def refusal_of_upload(client: Client, reference_id: str) -> ResourceExhausted | None:
    try:
        client.add_reference("s", NewReference(reference_id, PHOTO, CAMERA, pose(0.0)))
    except ResourceExhausted as error:
        return error
    return None


def test_the_server_reloads_its_files_and_needs_both_proofs(tmp_path: Path) -> None:
    root, new_root = authority(), authority("new")
    paths: dict[str, Any] = {
        name: tmp_path / name for name in ("tls_certificate", "tls_key", "tls_client_ca", "tokens_file")
    }
    signed(root, "server").write(paths["tls_certificate"], paths["tls_key"])
    paths["tls_client_ca"].write_bytes(root.certificate_pem)
    token = create_token(paths["tokens_file"], "robot", "acme", "write", None)
    robot = signed(root, "robot-7")

    def attempt(options: ConnectOptions) -> str:
        with Client(address, options) as client:
            return client.create_scene(f"s{time.monotonic_ns()}").scene_id[:1]

    with serving(tmp_path / "data", **paths) as server:
        address = server.address.replace("127.0.0.1", "localhost")
        assert attempt(options_of(robot, root, token=token)) == "s"
        with pytest.raises(Unauthenticated):
            attempt(options_of(robot, root))
        with pytest.raises(Unavailable):
            attempt(options_of(None, root, token=token))
        with pytest.raises(Unavailable):
            attempt(options_of(robot, new_root, token=token))
        signed(new_root, "server").write(paths["tls_certificate"], paths["tls_key"])

        def sees_the_new_one() -> bool:
            try:
                return attempt(options_of(robot, new_root, token=token)) == "s"
            except Unavailable:
                return False

        wait_until(sees_the_new_one)
        with pytest.raises(Unavailable):
            attempt(options_of(robot, root, token=token))
