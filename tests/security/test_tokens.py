"""Tokens: the file and its errors, changes while serving, and which role may call which method."""

import json
import logging
import os
import re
import stat
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta, timezone
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from grpc_health.v1 import health_pb2
from grpc_reflection.v1alpha import reflection_pb2
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from mapless.v1 import localization_service_pb2, reference_service_pb2
from mapless_server.errors import PermissionDenied, RequestError, Unauthenticated
from mapless_server.security import (
    DEFAULT_TENANT,
    METHOD_ROLES,
    OPEN_METHODS,
    Authenticator,
    Principal,
    Role,
    SceneLimit,
    SecurityError,
    Tokens,
    certificate_name,
    create_token,
    read_tokens,
    revoke_token,
    sha256_of,
    written_secret,
)
from mapless_server.security.protection import Protection
from mapless_server.security.reloading import Reloading
from mapless_server.settings import Settings
from mapless_tools.cli import tokens as command

NOW = datetime(2030, 1, 1, tzinfo=timezone.utc)
READ = "/mapless.v1.ReferenceService/GetScene"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "tokens.json"


def entry(**changes: Any) -> dict[str, Any]:
    return {"name": "robot", "tenant": "acme", "role": "read", "sha256": sha256_of("secret")} | changes


def authenticator(*entries: dict[str, Any], now: Callable[[], datetime] = lambda: NOW) -> Authenticator:
    tokens = Tokens.model_validate_json(json.dumps({"tokens": entries}))
    return Authenticator(lambda: tokens, now)


def bearer(token: str) -> tuple[tuple[str, str], ...]:
    return (("user-agent", "x"), ("authorization", f"Bearer {token}"))


class TestFile:
    def test_a_new_token_is_known_and_only_its_hash_is_on_disk(self, path: Path) -> None:
        token = create_token(path, "robot-7", "acme", "localize", NOW)
        assert re.fullmatch(r"mapless_[A-Za-z0-9_-]{43}", token)
        assert token.removeprefix("mapless_") not in path.read_text()
        known = read_tokens(path).find(token)
        assert known is not None
        assert (known.name, known.tenant, known.allows, known.expires) == ("robot-7", "acme", Role.LOCALIZE, NOW)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert os.listdir(path.parent) == [path.name]

    def test_tokens_differ_and_revoking_one_keeps_the_others(self, path: Path) -> None:
        made = {name: create_token(path, name, DEFAULT_TENANT, "read", None) for name in "abc"}
        revoke_token(path, "b")
        found = {name: read_tokens(path).find(token) for name, token in made.items()}
        assert [name for name, token in found.items() if token] == ["a", "c"]

    def test_the_limits_of_tenants_survive_a_change(self, path: Path) -> None:
        path.write_text('{"tokens": [], "tenants": {"acme": {"rate_ms": 250}, "other": {}}}')
        create_token(path, "a", "acme", "read", None)
        tokens = read_tokens(path)
        assert [tokens.rate_ms(tenant) for tenant in ("acme", "other", "unknown")] == [250, None, None]

    def test_a_limit_is_kept_and_reaches_the_caller(self, path: Path) -> None:
        limits: list[tuple[dict[str, Any], SceneLimit | None]] = [
            ({}, None),
            ({"scenes": ["lobby", "hall"]}, SceneLimit(frozenset({"lobby", "hall"}))),
            ({"labels": {"site": "a"}}, SceneLimit(labels=frozenset({("site", "a")}))),
            (
                {"scenes": ["lobby"], "labels": {"site": "a"}},
                SceneLimit(frozenset({"lobby"}), frozenset({("site", "a")})),
            ),
        ]
        for number, (held, expected) in enumerate(limits):
            token = create_token(path, f"t{number}", "acme", "read", None, **held)
            caller = Authenticator(lambda: read_tokens(path)).authenticate(bearer(token), READ)
            assert caller == Principal("acme", Role.READ, f"t{number}", expected)
        revoke_token(path, "t0")
        assert [it.limit for it in read_tokens(path).tokens] == [expected for _, expected in limits[1:]]

    def test_a_taken_name_is_refused_and_nothing_changes(self, path: Path) -> None:
        create_token(path, "a", "acme", "read", None)
        before = path.read_bytes()
        with pytest.raises(SecurityError, match="'a' exists already"):
            create_token(path, "a", "other", "write", None)
        assert path.read_bytes() == before

    @pytest.mark.parametrize(
        ("name", "tenant", "role", "what"),
        [
            ("a/b", "t", "read", "name"),
            ("a", "t/u", "read", "tenant"),
            ("a", "", "read", "tenant"),
            ("a", "t", "admin", "role"),
        ],
    )
    def test_malformed_names_and_roles_are_rejected(
        self, path: Path, name: str, tenant: str, role: str, what: str
    ) -> None:
        with pytest.raises(SecurityError, match=f"^{what}: "):
            create_token(path, name, tenant, role, None)
        assert not path.exists()

    def test_revoking_what_is_not_there_is_an_error(self, path: Path) -> None:
        with pytest.raises(SecurityError, match="No such file"):
            revoke_token(path, "a")
        create_token(path, "a", "t", "read", None)
        with pytest.raises(SecurityError, match="no token has the name 'b'"):
            revoke_token(path, "b")

    def test_commands_at_the_same_time_lose_no_token(self, path: Path) -> None:
        with ThreadPoolExecutor(8) as pool:
            made = list(pool.map(lambda i: create_token(path, f"t{i}", "acme", "read", None), range(24)))
        tokens = read_tokens(path)
        assert [tokens.find(token) is None for token in made] == [False] * 24

    def test_a_link_stays_a_link(self, path: Path, tmp_path: Path) -> None:
        target = tmp_path / "elsewhere" / "real.json"
        target.parent.mkdir()
        path.symlink_to(target)
        token = create_token(path, "a", "t", "read", None)
        assert path.is_symlink()
        assert read_tokens(target).find(token) == read_tokens(path).tokens[0]

    def test_a_folder_that_is_not_there_is_one_sentence(self, tmp_path: Path) -> None:
        with pytest.raises(SecurityError, match="absent: No such file"):
            create_token(tmp_path / "absent" / "tokens.json", "a", "t", "read", None)

    @pytest.mark.parametrize(
        ("content", "error_text"),
        [
            ("", "Invalid JSON"),
            ("[]", "valid dictionary|object"),
            ('{"token": []}', "token: Extra inputs"),
            (json.dumps({"tokens": [entry(sha256="mapless_oops-this-is-a-secret")]}), "tokens.0.sha256: .*pattern"),
            (json.dumps({"tokens": [entry(role="root")]}), "tokens.0.role"),
            (json.dumps({"tokens": [entry(expires="tomorrow")]}), "tokens.0.expires"),
            (json.dumps({"tokens": [entry(expires="2030-01-01T00:00:00")]}), "tokens.0.expires: .*timezone"),
            (json.dumps({"tokens": [entry(), entry(sha256=sha256_of("b"))]}), "two tokens have the name 'robot'"),
            (json.dumps({"tokens": [entry(), entry(name="b")]}), "two tokens have the sha256"),
            (json.dumps({"tokens": [entry(scenes=[])]}), "tokens.0.scenes: .*at least 1 item"),
            (json.dumps({"tokens": [entry(labels={})]}), "tokens.0.labels: .*at least 1 item"),
            (json.dumps({"tokens": [entry(scenes="lobby")]}), "tokens.0.scenes: .*array"),
            (json.dumps({"tokens": [entry(scene=["lobby"])]}), "tokens.0.scene: Extra inputs"),
            (json.dumps({"tokens": [entry(scenes=["scenes/lobby"])]}), "tokens.0.scenes.0: an id is"),
            (json.dumps({"tokens": [entry(scenes=["s"] * 1001)]}), "tokens.0.scenes: .*at most 1000"),
            (json.dumps({"tokens": [entry(labels={"si te": "a"})]}), "tokens.0.labels: must have names"),
            (json.dumps({"tokens": [entry(labels={"site": ""})]}), "tokens.0.labels: must have values"),
            ('{"tenants": {"a": {"rate_ms": -1}}}', "tenants.a.rate_ms"),
            ('{"tenants": {"a/b": {}}}', "tenants.a/b"),
        ],
    )
    def test_a_wrong_file_is_one_sentence_that_shows_no_secret(self, path: Path, content: str, error_text: str) -> None:
        path.write_text(content)
        with pytest.raises(SecurityError, match=error_text) as caught:
            read_tokens(path)
        assert str(caught.value).startswith(str(path))
        assert "\n" not in str(caught.value)
        assert "oops" not in str(caught.value)


class TestReloading:
    def make(self, path: Path) -> Reloading[Tokens]:
        return Reloading([path], lambda: read_tokens(path), "tokens")

    def test_a_missing_file_is_an_error_at_the_start(self, path: Path) -> None:
        with pytest.raises(SecurityError, match="No such file"):
            self.make(path)

    def test_a_changed_file_is_read_and_an_unchanged_one_is_not(self, path: Path) -> None:
        token = create_token(path, "a", "t", "read", None)
        source = self.make(path)
        first = source.value
        assert not source.refresh()
        assert source.value is first
        revoke_token(path, "a")
        assert source.refresh()
        assert (first.find(token) is not None, source.value.find(token)) == (True, None)

    def test_a_change_in_place_of_the_same_length_is_noticed(self, path: Path) -> None:
        path.write_text(json.dumps({"tokens": [entry(role="read ".strip())]}))
        source = self.make(path)
        old = path.stat()
        path.write_text(path.read_text().replace(sha256_of("secret"), sha256_of("sesame")))
        os.utime(path, ns=(old.st_atime_ns, old.st_mtime_ns + 1))
        assert path.stat().st_size == old.st_size
        assert source.refresh()
        assert source.value.find("secret") is None

    def test_a_change_while_the_file_is_read_is_noticed_afterwards(self, path: Path) -> None:
        path.write_text("{}")

        def read() -> Tokens:
            tokens = read_tokens(path)
            if not tokens.tokens:
                create_token(path, "a", "t", "read", None)
            return tokens

        source = Reloading([path], read, "tokens")
        assert not source.value.tokens
        assert source.refresh()
        assert [it.name for it in source.value.tokens] == ["a"]

    @pytest.mark.parametrize("broken", ["{", None])
    def test_a_broken_file_leaves_the_old_tokens_and_logs_once(
        self, path: Path, broken: str | None, caplog: pytest.LogCaptureFixture
    ) -> None:
        token = create_token(path, "a", "t", "read", None)
        good = path.read_bytes()
        source = self.make(path)
        if broken is None:
            path.unlink()
        else:
            path.write_text(broken)
        with caplog.at_level(logging.INFO):
            assert [source.refresh() for _ in range(3)] == [False] * 3
        assert [record.levelname for record in caplog.records] == ["ERROR"]
        assert source.value.find(token) == source.value.tokens[0]
        path.write_bytes(good)
        assert source.refresh()
        assert source.value.find(token) == source.value.tokens[0]

    def test_a_changed_file_is_read_again_after_a_failure(self, path: Path) -> None:
        path.write_text("{}")
        faults = [SecurityError("too many open files")]

        def read() -> Tokens:
            if path.read_text() != "{}" and faults:
                raise faults.pop()
            return read_tokens(path)

        source = Reloading([path], read, "tokens")
        token = create_token(path, "a", "t", "read", None)
        assert [source.refresh() for _ in range(2)] == [False, True]
        assert source.value.find(token) is not None


class TestAccess:
    def test_the_table_has_every_method_and_no_other(self) -> None:
        services = [
            service
            for file in (localization_service_pb2, reference_service_pb2)
            for service in file.DESCRIPTOR.services_by_name.values()
        ]
        methods = {f"/{service.full_name}/{method.name}" for service in services for method in service.methods}
        assert len(methods) >= 10
        assert set(METHOD_ROLES) == methods

    def test_the_open_methods_are_those_of_health_and_reflection(self) -> None:
        services = [
            *health_pb2.DESCRIPTOR.services_by_name.values(),
            *reflection_pb2.DESCRIPTOR.services_by_name.values(),
        ]
        methods = {f"/{service.full_name}/{method.name}" for service in services for method in service.methods}
        methods |= {method.replace("v1alpha", "v1") for method in methods}
        assert methods == OPEN_METHODS
        assert not OPEN_METHODS & set(METHOD_ROLES)

    def test_changing_long_computing_or_watching_takes_write(self) -> None:
        for method, role in METHOD_ROLES.items():
            name = method.rpartition("/")[2]
            much = r"Create|BatchCreate|Delete|Retire|Restore|Update|AuditScene|WatchQueries"
            takes_much = re.match(much, name) is not None
            assert (role is Role.WRITE) == takes_much, method

    @pytest.mark.parametrize(("method", "role"), list(product(METHOD_ROLES, ("read", "localize", "write"))))
    def test_each_role_may_call_its_methods_and_no_others(self, method: str, role: str) -> None:
        caller = authenticator(entry(role=role))
        if Role[role.upper()] >= METHOD_ROLES[method]:
            assert caller.authenticate(bearer("secret"), method) == Principal("acme", Role[role.upper()], "robot")
        else:
            with pytest.raises(PermissionDenied, match=METHOD_ROLES[method].name.lower()) as caught:
                caller.authenticate(bearer("secret"), method)
            assert caught.value.reason == "ROLE_TOO_LOW"

    @pytest.mark.parametrize("asks", [True, False])
    @pytest.mark.parametrize(
        "method", ["/mapless.v1.ReferenceService/New", "/other.Service/Do", "", *sorted(OPEN_METHODS)]
    )
    def test_a_method_without_a_role_is_rejected(self, method: str, asks: bool) -> None:
        caller = authenticator(entry(role="write")) if asks else Authenticator(None)
        with pytest.raises(PermissionDenied):
            caller.authenticate(bearer("secret"), method)

    @pytest.mark.parametrize(
        ("metadata", "reason"),
        [
            ((), "TOKEN_MISSING"),
            ((("authorisation", "Bearer secret"),), "TOKEN_MISSING"),
            ((("authorization", "secret"),), "TOKEN_INVALID"),
            ((("authorization", "Basic secret"),), "TOKEN_INVALID"),
            ((("authorization", "Bearer "),), "TOKEN_INVALID"),
            ((("authorization", ""),), "TOKEN_INVALID"),
            ((("authorization", "Bearer secret, Bearer secret"),), "TOKEN_INVALID"),
            (bearer("secret") * 2, "TOKEN_INVALID"),
            (bearer("Secret"), "TOKEN_INVALID"),
            (bearer(sha256_of("secret")), "TOKEN_INVALID"),
            (bearer("late"), "TOKEN_EXPIRED"),
        ],
    )
    def test_a_missing_or_wrong_token_has_a_reason(self, metadata: Any, reason: str) -> None:
        late = entry(name="late", sha256=sha256_of("late"), expires=NOW.isoformat())
        with pytest.raises(Unauthenticated) as caught:
            authenticator(entry(), late).authenticate(metadata, READ)
        assert (caught.value.reason, caught.value.code) == (reason, "UNAUTHENTICATED")
        assert "secret" not in str(caught.value).lower()

    def test_a_revoked_token_and_an_unknown_one_look_the_same(self, path: Path) -> None:
        revoked = create_token(path, "a", "t", "read", None)
        revoke_token(path, "a")
        caller = Authenticator(lambda: read_tokens(path))
        answers = set()
        for token in (revoked, revoked.swapcase()):
            with pytest.raises(RequestError) as caught:
                caller.authenticate(bearer(token), READ)
            answers.add((type(caught.value), str(caught.value), caught.value.reason))
        assert len(answers) == 1

    def test_a_token_is_good_until_the_moment_it_expires(self) -> None:
        now = [NOW - timedelta(microseconds=1)]
        caller = authenticator(entry(expires=NOW.isoformat()), now=lambda: now[0])
        assert caller.authenticate(bearer("secret"), READ).name == "robot"
        now[0] = NOW
        with pytest.raises(Unauthenticated) as caught:
            caller.authenticate(bearer("secret"), READ)
        assert caught.value.reason == "TOKEN_EXPIRED"

    @given(st.text(st.characters(codec="utf-8"), max_size=30))
    def test_no_other_text_is_accepted_as_a_token(self, text: str) -> None:
        with pytest.raises(Unauthenticated):
            authenticator(entry(sha256=sha256_of("secret" * 3))).authenticate((("authorization", text),), READ)

    def test_the_scheme_is_read_in_any_case(self) -> None:
        caller = authenticator(entry())
        assert caller.authenticate((("authorization", "bEaReR secret"),), READ).tenant == "acme"

    def test_without_tokens_all_are_the_default_tenant(self) -> None:
        caller = Authenticator(None)
        assert caller.authenticate((), READ) == Principal(DEFAULT_TENANT, Role.WRITE, "")
        context = {"x509_common_name": [b"robot-7"], "x509_subject_alternative_name": [b"r7.example"]}
        assert caller.authenticate(bearer("whatever"), READ, context).name == "robot-7"

    def test_a_certificate_cannot_write_lines_into_the_log(self) -> None:
        assert certificate_name({"x509_common_name": [b"a\nb\x1b[0m\xff"]}) == "a?b?[0m\ufffd"
        assert certificate_name({"x509_subject_alternative_name": [b"x" * 999]}) == "x" * 128
        assert certificate_name({"x509_common_name": []}) == ""


class TestCommand:
    def run(self, *arguments: str, path: Path) -> tuple[int, str, str]:
        result = CliRunner().invoke(command.token_app, [*arguments, "--tokens-file", str(path)])
        return result.exit_code, result.stdout, result.stderr

    def test_create_prints_the_token_alone_then_list_and_revoke(self, path: Path) -> None:
        create = ("create", "--name", "robot-7", "--tenant", "acme", "--role", "localize")
        code, token, said = self.run(*create, "--expires", "2099-01-01T00:00:00Z", path=path)
        assert (code, token.count("\n")) == (0, 1)
        assert token.strip() not in said
        known = read_tokens(path).find(token.strip())
        assert known is not None
        assert (known.name, known.role, known.expires) == (
            "robot-7",
            "localize",
            datetime(2099, 1, 1, tzinfo=timezone.utc),
        )
        (entry,) = json.loads(self.run("list", path=path)[1])  # for programs, without the hash
        assert {*entry} == {"name", "tenant", "role", "expires", "scenes", "labels"}
        code, listed, _ = self.run("list", "--text", path=path)
        assert code == 0
        assert listed == "robot-7  localize  tenant acme  expires 2099-01-01T00:00:00+00:00\n"
        assert self.run("create", "b", "--role", "read", path=path)[0] == 0  # names are arguments or options
        assert self.run("revoke", "--name", "robot-7", path=path) == (0, "", "")
        assert self.run("revoke", "b", path=path) == (0, "", "")
        assert self.run("list", "--text", path=path) == (0, "", "")

    @pytest.mark.parametrize(
        ("arguments", "code", "error_text"),
        [
            (("create", "--name", "a", "--role", "king"), 1, "role"),
            (("create", "--name", "a", "--role", "read", "--expires", "soon"), 2, "--expires"),
            (("create", "--name", "a", "--role", "read", "--expires", "2099-01-01T00:00:00"), 2, "--expires"),
            (("create", "--name", "a", "--role", "read", "--expires", "2001-01-01T00:00:00Z"), 2, "in the future"),
            (("create", "--name", "a", "--role", "read", "--scene", "scenes/lobby"), 2, "--scene: an id is"),
            (
                ("create", "--name", "a", "--role", "read", "--label", "site"),
                2,
                "NAME=VALUE, such as site=a, not",
            ),
            (("create", "--name", "a", "--role", "read", "--label", "s=a", "--label", "s=b"), 2, "no scene has both"),
            (("create", "--name", "a", "--role", "read", "--label", "=a"), 2, "--label takes NAME=VALUE"),
            (("create", "--name", "old", "--role", "read"), 1, "already"),
            (("revoke", "a"), 1, "no token"),
            (("create", "--role", "read"), 2, "one name"),
            (("revoke", "old", "--name", "old"), 2, "one name"),
        ],
    )
    def test_complaints_are_one_line(self, path: Path, arguments: tuple[str, ...], code: int, error_text: str) -> None:
        create_token(path, "old", "t", "read", None)
        found_code, printed, said = self.run(*arguments, path=path)
        assert (found_code, printed, said.count("\n")) == (code, "", 1)
        assert error_text in said

    def test_the_list_shows_what_a_token_is_for(self, path: Path) -> None:
        limit = ("--scene", "lobby", "--scene", "hall", "--scene", "lobby", "--label", "site=a", "--label", "floor=2")
        assert self.run("create", "--name", "a", "--role", "read", *limit, path=path)[0] == 0
        many = [part for number in range(7) for part in ("--scene", f"s{number}")]
        assert self.run("create", "--name", "b", "--role", "read", *many, path=path)[0] == 0
        first, second = self.run("list", "--text", path=path)[1].splitlines()
        assert first.endswith("  only lobby, hall and scenes with site=a, floor=2")
        assert second.endswith("  only s0, s1, s2, s3, s4 and 2 more")
        listed = json.loads(self.run("list", path=path)[1])
        assert (listed[0]["scenes"], listed[0]["labels"]) == (["lobby", "hall"], {"site": "a", "floor": "2"})

    def test_the_setting_names_the_file(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """The client's variable MAPLESS_TOKEN is no setting, and no error."""
        assert command.DEFAULT_TENANT == DEFAULT_TENANT
        monkeypatch.setenv("MAPLESS_TOKEN", "mapless_x")
        monkeypatch.delenv("MAPLESS_TOKENS_FILE", raising=False)
        result = CliRunner().invoke(command.token_app, ["list", "--text"])
        assert (result.exit_code, "MAPLESS_TOKENS_FILE" in result.stderr) == (2, True)
        create_token(path, "a", "t", "read", None)
        monkeypatch.setenv("MAPLESS_TOKENS_FILE", str(path))
        result = CliRunner().invoke(command.token_app, ["list", "--text"])
        assert result.stdout == "a  read      tenant t  never expires\n"


def test_a_secret_is_written_for_its_owner_alone(tmp_path: Path) -> None:
    """Whatever the umask; no file is replaced, and a failed command leaves none."""
    mask = os.umask(0)
    try:
        with written_secret(tmp_path / "new") as file:
            file.write("secret")
    finally:
        os.umask(mask)
    assert (tmp_path / "new").stat().st_mode & 0o777 == 0o600
    with pytest.raises(SecurityError, match="exists already"), written_secret(tmp_path / "new") as file:
        file.write("other")
    assert (tmp_path / "new").read_text() == "secret"
    with pytest.raises(SecurityError, match="No such file"), written_secret(tmp_path / "no" / "folder"):
        pass
    with pytest.raises(ValueError, match="cannot"), written_secret(tmp_path / "failed"):
        raise ValueError("cannot")
    assert not (tmp_path / "failed").exists()


def test_files_that_everybody_reads_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "tokens"
    create_token(file, "robot", "default", "read", None)
    for mode, is_warned in ((0o600, False), (0o440, False), (0o644, True), (0o602, True)):
        caplog.clear()
        file.chmod(mode)
        Protection.of(Settings(tokens_file=file))
        assert ("every user of this machine" in caplog.text) == is_warned


def test_a_new_token_is_in_the_named_file_alone(tmp_path: Path) -> None:
    """And not in that of hashes, if both are the same."""
    tokens, other = tmp_path / "tokens", tmp_path / "robot.token"
    asked = ["create", "robot", "--role", "localize", "--tokens-file", str(tokens), "--output"]
    assert CliRunner().invoke(command.token_app, [*asked, str(tokens)]).exit_code == 1
    assert not tokens.exists()
    result = CliRunner().invoke(command.token_app, [*asked, str(other)])
    token = other.read_text().strip()
    assert result.exit_code == 0
    assert token not in result.output
    assert read_tokens(tokens).find(token) is not None
    assert CliRunner().invoke(command.token_app, [*asked, str(other)]).exit_code == 1
    assert other.read_text().strip() == token
