"""The Dockerfile and the compose files: valid, confined, with settings that the server takes, and a server that starts.

hadolint checks the Dockerfile, the compose specification's schema the compose files. No container engine is needed.
"""

import json
import logging
import os
import re
import shlex
import signal
import subprocess
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import jsonschema
import pytest
import yaml  # type: ignore[import-untyped]
from sqlalchemy import make_url
from support.project import PROJECT, ROOT
from support.waiting import LIMIT_S, wait_until

from bench.load.driving import free_port
from mapless_server.security import assess_binding
from mapless_server.settings import PREFIX, Settings, load_settings
from mapless_server.store.postgresql import CONNECTIONS_AT_MOST

DEPLOY = ROOT / "deploy"
DOCKERFILE = ROOT / "docker" / "Dockerfile"
PROGRAMS = Path(sys.executable).parent
HADOLINT = PROGRAMS / "hadolint"
TEXT = re.sub(r"\\\n\s*", "", re.sub(r"(?m)^#.*\n", "", DOCKERFILE.read_text()))
STAGES = {name: stage for stage in TEXT.split("\nFROM ")[1:] for name in re.findall(r"^\S+ AS (\S+)", stage)}
PINNED = re.compile(r"([\w./-]+:v?\d+\.\d+|postgres:\d+)\.\d+[\w.-]*(@sha256:[0-9a-f]{64})?")
"""PostgreSQL's versions have two numbers since 10."""

Json = dict[str, Any]


class Overriding(list[Any]):
    """A sequence that takes the place of the one in the file below, where others are added to it."""


class ComposeLoader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML with Compose's tag."""


ComposeLoader.add_constructor("!override", lambda loader, node: Overriding(loader.construct_sequence(node)))


def merged(below: Any, above: Any) -> Any:
    """Two files as Compose takes them together: keys and lists are joined, but commands and overrides."""
    if isinstance(below, dict) and isinstance(above, dict):
        joined = dict(below)
        for key, value in above.items():
            joined[key] = merged(below[key], value) if key in below and key != "command" else value
        return joined
    if isinstance(below, list) and isinstance(above, list) and not isinstance(above, Overriding):
        return below + above
    return above


FILES = {it.name: yaml.load(it.read_text(), ComposeLoader) for it in sorted(DEPLOY.glob("compose*.yaml"))}
COMPOSE, CUDA, POSTGRES = (FILES[f"compose{it}.yaml"] for it in ("", ".cuda", ".postgres"))
SHARED = merged(COMPOSE, POSTGRES)
TOGETHER = {"cpu": COMPOSE, "cuda": merged(COMPOSE, CUDA), "shared": SHARED, "both": merged(SHARED, CUDA)}


def all_of(stage: str, word: str) -> list[str]:
    """The arguments of an instruction in a stage and in those that it is built on, theirs first."""
    base = re.match(r"(\S+) AS", STAGES[stage])[1]  # type: ignore[index]
    return (all_of(base, word) if base in STAGES else []) + re.findall(rf"(?m)^{word} (.*)", STAGES[stage])


def environment_of(stage: str) -> dict[str, str]:
    return dict(pair.split("=", 1) for line in all_of(stage, "ENV") for pair in shlex.split(line))


def settings_under(given: Json, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """The server's settings by the image's variables and these; an unknown name or a wrong value raises."""
    for name, value in (environment_of("cpu") | given).items():
        if name.startswith(PREFIX):
            monkeypatch.setenv(name, str(value))
    return load_settings({}).settings


def seconds(text: str) -> float:
    number, unit = re.fullmatch(r"(\d+)(s|m)", text).groups()  # type: ignore[union-attr]
    return float(number) * {"s": 1, "m": 60}[unit]


@pytest.mark.skipif(not HADOLINT.is_file(), reason="hadolint has no wheel for this machine")
def test_hadolint_finds_no_fault_in_the_dockerfile() -> None:
    # Not DL3008: a compiler's version is the base image's.
    said = subprocess.run([HADOLINT, "--ignore", "DL3008", DOCKERFILE], capture_output=True, text=True, timeout=60)
    assert (said.returncode, said.stdout) == (0, "")


@pytest.mark.parametrize("name", FILES)
def test_compose_files_keep_to_the_specification(name: str) -> None:
    pytest.importorskip("check_jsonschema", reason="needs check-jsonschema, of the extra `dev`")
    schema = json.loads((files("check_jsonschema.builtin_schemas") / "vendor/compose-spec.json").read_text())
    jsonschema.validate(FILES[name], schema)


def test_what_is_copied_exists_and_reaches_the_build() -> None:
    assert PINNED.fullmatch(re.findall(r"ARG PYTHON_IMAGE=(.*)", DOCKERFILE.read_text())[0])
    let_through = (DOCKERFILE.parent / "Dockerfile.dockerignore").read_text().splitlines()
    for line in re.findall(r"(?m)^COPY (?!--from)(.*) \S+$", TEXT):
        for source in line.split():
            assert (ROOT / source).exists()
            assert f"!{source}" in let_through


@pytest.mark.parametrize("stage", ["cpu", "cuda"])
def test_an_image_serves_without_root_or_open_doors(stage: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", all_of(stage, "USER")[-1])  # numbers show Kubernetes that it is not root
    assert json.loads(all_of(stage, "ENTRYPOINT")[-1]) + json.loads(all_of(stage, "CMD")[-1]) == [
        "mapless-server",
        "serve",
    ]
    settings = settings_under(environment_of(stage), monkeypatch)
    assert all_of(stage, "EXPOSE") == [f"{settings.port} {settings.metrics_port}"]
    assert settings.metrics_host == settings.host == "0.0.0.0"
    assert assess_binding(settings)[0] == logging.CRITICAL
    volumes = json.loads(all_of(stage, "VOLUME")[-1])
    for name in ("MAPLESS_DATA_DIR", "MAPLESS_WEIGHTS_DIR", "HOME", "XDG_CACHE_HOME", "TORCHINDUCTOR_CACHE_DIR"):
        assert any(environment_of(stage)[name].startswith(volume) for volume in volumes)
        assert all(f" {volume}" in all_of("runtime", "RUN")[0] for volume in volumes)


def test_extras_and_torch_are_the_projects() -> None:
    (torch,) = re.findall(r"^TORCH_VERSION := (.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for stage in ("build-cpu", "build-cuda"):
        (extras,) = re.findall(r"(?m)^ARG EXTRAS=(.*)", STAGES[stage])
        assert {"server", "networks"} <= set(extras.split(",")) <= set(PROJECT["optional-dependencies"])
        assert re.findall(r"(?m)^ARG TORCH=(.*)", STAGES[stage]) == [f"torch=={torch}"]


def test_what_compose_refers_to_exists() -> None:
    sources = [it.split(":")[0] for service in SHARED["services"].values() for it in service["volumes"]]
    assert all((DEPLOY / it).is_dir() for it in sources if it.startswith("."))
    assert {it for it in sources if not it.startswith(".")} == set(SHARED["volumes"])
    for stage, document in (("cpu", COMPOSE), ("cuda", CUDA)):
        server = document["services"]["mapless"]
        assert (server["build"]["target"], server["image"]) == (stage, f"mapless:{PROJECT['version']}-{stage}")


@pytest.mark.parametrize("name", SHARED["services"])
def test_every_service_is_confined(name: str) -> None:
    service = SHARED["services"][name]
    assert PINNED.fullmatch(service["image"])
    assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert {"cpus", "mem_limit"} <= set(service)
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
    assert name == "mapless" or "healthcheck" in service  # whose image has one


@pytest.mark.parametrize("name", TOGETHER)
def test_compose_runs_the_server_within_its_means(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    service = TOGETHER[name]["services"]["mapless"]
    settings = settings_under(service["environment"], monkeypatch)
    assert settings.workers == service["cpus"]
    count = service.get("deploy", {}).get("replicas", 1)
    (published,) = service["ports"]
    last = f"-{settings.port + count - 1}" if count > 1 else ""  # a port each
    assert published == f"127.0.0.1:{settings.port}{last}:{settings.port}"
    assert assess_binding(settings)[0] == logging.WARNING  # open, since only this machine reaches it
    assert seconds(service["stop_grace_period"]) > settings.drain_delay_s + settings.drain_grace_s
    mounted = {volume.split(":")[1] for volume in service["volumes"]} | set(service["tmpfs"])
    assert mounted == {*json.loads(all_of("cpu", "VOLUME")[-1]), "/tmp"}
    assert (settings.database_url is None) is (count == 1)  # a store of its own has one server


def test_servers_of_compose_reach_the_database_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """By name, port, user and password, which comes from outside; it has room for all their connections."""
    server, database = SHARED["services"]["mapless"], SHARED["services"]["postgres"]
    settings = settings_under(server["environment"], monkeypatch)
    assert settings.database_url is not None
    url, made = make_url(settings.database_url.get_secret_value()), database["environment"]
    assert (url.host, url.port, url.drivername) == ("postgres", 5432, "postgresql")
    assert (url.username, url.database) == (made["POSTGRES_USER"], made["POSTGRES_DB"])
    assert made["POSTGRES_PASSWORD"] == url.password
    assert re.fullmatch(r"\$\{POSTGRES_PASSWORD:\?[^}]+\}", str(url.password))
    assert ".env" in (ROOT / ".gitignore").read_text().splitlines()
    assert server["depends_on"]["postgres"] == {"condition": "service_healthy"}
    assert (database["ports"], database["user"]) == ([], "70:70")
    options = dict(word.removeprefix("--").split("=") for word in database["command"] if word.startswith("--"))
    reserved = 3  # for superusers, PostgreSQL's default
    assert int(options["max_connections"]) >= server["deploy"]["replicas"] * CONNECTIONS_AT_MOST + reserved
    assert not {"fsync", "full_page_writes", "synchronous_commit"} & set(options)


def test_the_server_starts_as_compose_starts_it(tmp_path: Path) -> None:
    """With the image's variables, and health, probes and end as they are deployed; on ports and folders of the test."""
    compose = COMPOSE["services"]["mapless"]
    port, metrics_port = free_port(), free_port()
    here = {"MAPLESS_HOST": "127.0.0.1", "MAPLESS_METRICS_HOST": "127.0.0.1", "MAPLESS_PORT": str(port)}
    here |= {
        "MAPLESS_METRICS_PORT": str(metrics_port),
        "MAPLESS_DATA_DIR": str(tmp_path),
        "MAPLESS_WEIGHTS_DIR": str(tmp_path),
    }
    variables = {
        it: str(value) for it, value in (environment_of("cpu") | compose["environment"]).items() if it[:8] == PREFIX
    }
    environment = os.environ | variables | here | {"MAPLESS_ADDRESS": f"localhost:{port}"}
    program, *arguments = json.loads(all_of("cpu", "ENTRYPOINT")[-1]) + json.loads(all_of("cpu", "CMD")[-1])
    (check,) = all_of("cpu", "HEALTHCHECK")
    client, *asked = json.loads(check.partition(" CMD ")[2])
    with subprocess.Popen([PROGRAMS / program, *arguments], env=environment) as server:
        try:
            health = [PROGRAMS / client, *asked]
            wait_until(lambda: subprocess.run(health, env=environment, capture_output=True, timeout=60).returncode == 0)
            manifests = "".join(it.read_text() for it in (DEPLOY / "kubernetes").rglob("statefulset.yaml"))
            for path in {*re.findall(r"path: (/\w+)$", manifests, re.MULTILINE), "/metrics"}:
                with urlopen(f"http://127.0.0.1:{metrics_port}{path}", timeout=LIMIT_S) as answer:
                    assert answer.status == 200, path
            server.send_signal(getattr(signal, all_of("cpu", "STOPSIGNAL")[-1]))
            assert server.wait(seconds(compose["stop_grace_period"])) == 0
        finally:
            server.kill()
