"""The images and the compose files match the code: ports, settings, times, folders; and nothing is left unprotected.

No container engine is needed: the files are read. What is true of an image holds for every target of the Dockerfile.
"""

import json
import logging
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]
from sqlalchemy import make_url

from mapless.cli.arguments import make_parser
from mapless_server.security import assess_binding
from mapless_server.settings import PREFIX, Settings, load_settings
from mapless_server.store.postgresql import CONNECTIONS_AT_MOST

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
DOCKERFILE = ROOT / "docker" / "Dockerfile"
DEPLOY = ROOT / "deploy"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
TARGETS = ["cpu", "cuda"]
PINNED = re.compile(r"([\w./-]+:v?\d+\.\d+|postgres:\d+)\.\d+[\w.-]*(@sha256:[0-9a-f]{64})?")
"""PostgreSQL's versions have two numbers since 10."""

Json = dict[str, Any]
Instruction = tuple[str, str]


def parse(dockerfile: str) -> list[Instruction]:
    """The instructions, without comments and with continued lines joined."""
    lines = [line for line in dockerfile.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [(word.upper(), rest.strip()) for word, _, rest in (line.partition(" ") for line in joined.splitlines())]


def stages_of(instructions: list[Instruction]) -> dict[str, tuple[str, list[Instruction]]]:
    """By name: what each stage builds on, and its instructions."""
    stages: dict[str, tuple[str, list[Instruction]]] = {}
    here: list[Instruction] = []
    for word, rest in instructions:
        if word == "FROM":
            base, _, name = rest.partition(" AS ")
            assert name not in stages
            assert base == "${PYTHON_IMAGE}" or base in stages, f"{base} comes later, or is no stage"
            here = []
            stages[name] = (base, here)
        else:
            here.append((word, rest))
    return stages


INSTRUCTIONS = parse(DOCKERFILE.read_text())
STAGES = stages_of(INSTRUCTIONS)


class Overriding(list[Any]):
    """A sequence that takes the place of the one in the file below, where others are added to it."""


class ComposeLoader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML with Compose's tag."""


ComposeLoader.add_constructor("!override", lambda loader, node: Overriding(loader.construct_sequence(node)))


def compose_file(name: str) -> Json:
    """One of the compose files, by itself."""
    document: Json = yaml.load((DEPLOY / name).read_text(), ComposeLoader)
    return document


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


COMPOSE, CUDA, POSTGRES = map(compose_file, ("compose.yaml", "compose.cuda.yaml", "compose.postgres.yaml"))
SHARED = merged(COMPOSE, POSTGRES)


def chain(target: str) -> list[Instruction]:
    """All instructions that make a target, those of its bases first."""
    base, own = STAGES[target]
    return (chain(base) if base in STAGES else []) + own


def all_of(target: str, word: str) -> list[str]:
    return [rest for found, rest in chain(target) if found == word]


def arguments_of(stage: str) -> list[tuple[str, str, str]]:
    """Names and defaults of a stage's own arguments."""
    return [rest.partition("=") for word, rest in STAGES[stage][1] if word == "ARG"]


def environment_of(target: str) -> dict[str, str]:
    pairs = [pair.partition("=") for line in all_of(target, "ENV") for pair in shlex.split(line)]
    return {name: value for name, _, value in pairs}


def ours(environment: Json) -> dict[str, str]:
    return {name: str(value) for name, value in environment.items() if name.startswith(PREFIX)}


def settings_under(environment: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Settings:
    """What the server makes of variables; an unknown name or a wrong value raises."""
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    return load_settings({}).settings


def seconds(text: str) -> float:
    number, unit = re.fullmatch(r"(\d+)(s|m)", text).groups()  # type: ignore[union-attr]
    return float(number) * {"s": 1, "m": 60}[unit]


def services() -> Iterator[tuple[str, Json]]:
    """What runs when all files but the GPU's are put together."""
    yield from SHARED["services"].items()


# The Dockerfile


def test_the_base_is_pinned() -> None:
    (base,) = [
        rest.removeprefix("PYTHON_IMAGE=")
        for word, rest in INSTRUCTIONS
        if (word, rest[:13]) == ("ARG", "PYTHON_IMAGE=")
    ]
    assert PINNED.fullmatch(base)
    assert set(TARGETS) <= set(STAGES)


def test_what_is_copied_exists_and_reaches_the_build() -> None:
    ignored, *let_through = [
        line for line in (DOCKERFILE.parent / "Dockerfile.dockerignore").read_text().splitlines() if line[0] != "#"
    ]
    assert ignored == "*"
    copied = [rest.split() for word, rest in INSTRUCTIONS if word == "COPY"]
    for *sources, _ in copied:
        if sources[0].startswith("--from="):
            assert sources[0].removeprefix("--from=") in STAGES
            continue
        for source in sources:
            assert (ROOT / source).exists()
            assert f"!{source}" in let_through


@pytest.mark.parametrize("target", TARGETS)
def test_an_image_runs_the_server_without_root(target: str) -> None:
    uid, gid = all_of(target, "USER")[-1].split(":")
    assert int(uid) > 0 < int(gid)  # a number, since only that lets Kubernetes see that it is not root
    assert chain(target)[-1][0] == "USER"
    command = json.loads(all_of(target, "ENTRYPOINT")[-1]) + json.loads(all_of(target, "CMD")[-1])
    assert command == ["mapless-server", "serve"]
    assert command[0] in PROJECT["scripts"]
    assert all_of(target, "STOPSIGNAL") == ["SIGTERM"]
    assert all_of(target, "EXPOSE") == [f"{default('port')} {default('metrics_port')}"]


@pytest.mark.parametrize("target", TARGETS)
def test_an_image_checks_its_health_with_our_client(target: str) -> None:
    (check,) = all_of(target, "HEALTHCHECK")
    options, _, command = check.partition(" CMD ")
    program, *arguments = json.loads(command)
    parsed = make_parser().parse_args(arguments)
    assert program in PROJECT["scripts"]
    assert parsed.run.__name__ == "health"
    assert parsed.address == f"localhost:{default('port')}"
    assert parsed.timeout < seconds(re.search(r"--timeout=(\w+)", options)[1])  # type: ignore[index]


@pytest.mark.parametrize("target", TARGETS)
def test_an_image_sets_known_settings_and_none_of_security(target: str, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_under(ours(environment_of(target)), monkeypatch)
    assert (settings.tls_certificate, settings.tokens_file, settings.insecure) == (None, None, False)
    assert assess_binding(settings)[0] == logging.CRITICAL
    assert settings.metrics_host == settings.host == "0.0.0.0"


@pytest.mark.parametrize("target", TARGETS)
def test_what_an_image_writes_to_is_a_volume(target: str) -> None:
    environment = environment_of(target)
    volumes = json.loads(all_of(target, "VOLUME")[-1])
    for name in ("MAPLESS_DATA_DIR", "MAPLESS_WEIGHTS_DIR", "HOME", "XDG_CACHE_HOME", "TORCHINDUCTOR_CACHE_DIR"):
        assert any(environment[name] == volume or environment[name].startswith(volume + "/") for volume in volumes)
    (created,) = [line.partition("install --directory ")[2] for line in all_of("runtime", "RUN")]
    assert set(volumes) == {word for word in created.split() if word.startswith("/")}


def test_versions_and_extras_are_the_projects() -> None:
    arguments = [argument for stage in STAGES for argument in arguments_of(stage)]
    assert [value for name, _, value in arguments if name == "VERSION"] == [PROJECT["version"]]
    for extras in [value for name, _, value in arguments if name == "EXTRAS"]:
        assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])
    for stage in ("build-cpu", "build-cuda"):  # what the documentation recommends runs in both
        (extras,) = [value for name, _, value in arguments_of(stage) if name == "EXTRAS"]
        assert "networks" in extras.split(",")
    (torch,) = re.findall(r"^TORCH_VERSION := (.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert [value for name, _, value in arguments if name == "TORCH"] == [f"torch=={torch}"] * len(TARGETS)


# Compose


def test_what_compose_refers_to_exists() -> None:
    used = set()
    for _, service in services():
        for volume in service["volumes"]:
            source = volume.split(":")[0]
            if source.startswith("."):
                assert (DEPLOY / source).is_dir()
            else:
                used.add(source)
        assert set(service.get("depends_on", ())) <= set(SHARED["services"])
    assert used == set(SHARED["volumes"])
    assert "postgres" not in COMPOSE["volumes"]
    (config,) = [word for word in COMPOSE["services"]["prometheus"]["command"] if word.startswith("--config.file=")]
    assert (DEPLOY / "prometheus" / Path(config).name).is_file()
    assert f"./prometheus:{Path(config.partition('=')[2]).parent}:ro" in COMPOSE["services"]["prometheus"]["volumes"]


@pytest.mark.parametrize(("document", "target"), [(COMPOSE, "cpu"), (CUDA, "cuda")], ids=TARGETS)
def test_compose_builds_a_target_of_the_dockerfile(document: Json, target: str) -> None:
    service = document["services"]["mapless"]
    assert service["build"]["target"] == target
    assert service["image"] == f"mapless:{PROJECT['version']}-{target}"
    build = COMPOSE["services"]["mapless"]["build"]
    assert (DEPLOY / build["context"] / build["dockerfile"]).resolve() == DOCKERFILE


@pytest.mark.parametrize(("name", "service"), list(services()))
def test_every_service_is_confined(name: str, service: Json) -> None:
    assert PINNED.fullmatch(service["image"])
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert service["cpus"] > 0
    assert re.fullmatch(r"\d+[mg]", service["mem_limit"])
    assert all(port.startswith("127.0.0.1:") for port in service["ports"])
    if name != "mapless":  # whose image has one
        assert service["healthcheck"]["test"][0] == "CMD"


@pytest.mark.parametrize(
    "document", [COMPOSE, merged(COMPOSE, CUDA), SHARED, merged(SHARED, CUDA)], ids=["cpu", "cuda", "shared", "both"]
)
def test_compose_runs_the_server_within_its_means(document: Json, monkeypatch: pytest.MonkeyPatch) -> None:
    service = document["services"]["mapless"]
    settings = settings_under(ours(environment_of("cpu")) | ours(service["environment"]), monkeypatch)
    assert settings.workers == service["cpus"]
    (published,) = service["ports"]
    address, first, last, port = re.fullmatch(r"(.*):(\d+)(?:-(\d+))?:(\d+)", published).groups()  # type: ignore[union-attr]
    assert (address, int(first), int(port)) == ("127.0.0.1", settings.port, settings.port)
    assert int(last or first) - int(first) + 1 == service.get("deploy", {}).get("replicas", 1)  # a port each
    assert assess_binding(settings)[0] == logging.WARNING  # open, since only this machine reaches it
    assert seconds(service["stop_grace_period"]) > settings.drain_delay_s + settings.drain_grace_s
    mounted = {volume.split(":")[1] for volume in service["volumes"]} | set(service["tmpfs"])
    assert mounted == {*json.loads(all_of("cpu", "VOLUME")[-1]), "/tmp"}


def test_a_store_of_its_own_has_one_server(monkeypatch: pytest.MonkeyPatch) -> None:
    service = COMPOSE["services"]["mapless"]
    assert settings_under(ours(service["environment"]), monkeypatch).database_url is None
    assert "replicas" not in service.get("deploy", {})


def test_servers_of_compose_reach_the_database_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """By name, port, user and password; it has room for all their connections, and accepts no other user."""
    server, database = SHARED["services"]["mapless"], SHARED["services"]["postgres"]
    settings = settings_under(ours(server["environment"]), monkeypatch)
    assert settings.database_url is not None
    url = make_url(settings.database_url.get_secret_value())
    made = database["environment"]
    assert (url.host, url.port, url.drivername) == ("postgres", 5432, "postgresql")
    assert (url.username, url.database) == (made["POSTGRES_USER"], made["POSTGRES_DB"])
    assert made["POSTGRES_PASSWORD"] == url.password
    assert re.fullmatch(r"\$\{POSTGRES_PASSWORD:\?[^}]+\}", str(url.password))  # from outside, or nothing starts
    assert ".env" in (ROOT / ".gitignore").read_text().splitlines()
    assert server["depends_on"]["postgres"] == {"condition": "service_healthy"}
    assert database["ports"] == []
    assert int(database["user"].split(":")[0]) > 0
    options = dict(word.removeprefix("--").split("=") for word in database["command"] if word.startswith("--"))
    reserved = 3  # for superusers, PostgreSQL's default
    assert int(options["max_connections"]) >= server["deploy"]["replicas"] * CONNECTIONS_AT_MOST + reserved
    assert not {"fsync", "full_page_writes", "synchronous_commit"} & set(options)
    memory_mib = {"m": 1, "g": 1024}[database["mem_limit"][-1]] * int(database["mem_limit"][:-1])
    assert int(options["shared_buffers"].removesuffix("MB")) <= memory_mib / 4


def default(setting: str) -> Any:
    return Settings.model_fields[setting].default
