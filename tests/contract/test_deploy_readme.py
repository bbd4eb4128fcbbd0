"""What the README of deployment says is so: commands are understood, files and settings exist, figures hold."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import typer.main

from mapless.cli.arguments import make_parser
from mapless_server.errors import Unavailable
from mapless_server.settings import Settings, load_settings
from mapless_server.store.postgresql import CONNECTION_WAIT_S, CONNECTIONS_AT_MOST, CONNECTIONS_KEPT, RETRY_AFTER_S
from mapless_tools.cli.app import app

DEPLOY = Path(__file__).parents[2] / "deploy"
README = (DEPLOY / "README.md").read_text()
INDENTED = "\n".join(re.findall(r"^ {4}(.*)$", README, re.MULTILINE)).replace("\\\n", "")


def commands(program: str, before: str = "") -> list[list[str]]:
    """The arguments of every line that runs a program, perhaps after something."""
    found = re.findall(rf"^{before}{program} (.*)$", INDENTED, re.MULTILINE)
    return [shlex.split(re.sub(r"\[(\w+)\]", r"\1", line), comments=True) for line in found]


def test_the_commands_of_the_server_are_understood() -> None:
    group = typer.main.get_command(app)
    seen = commands("mapless-server", before="(?:.* )?")
    assert {tuple(words[:2]) for words in seen} >= {("store", it) for it in ("backup", "verify", "restore", "migrate")}
    for arguments in seen:
        command, rest = group, arguments
        context = typer.Context(command)
        while hasattr(command, "resolve_command"):
            _, command, rest = command.resolve_command(context, rest)
            context = typer.Context(command, parent=context)
        command.parse_args(context, rest)  # raises where it does not understand


def test_the_commands_of_the_client_are_understood() -> None:
    (seen,) = commands("mapless")
    make_parser().parse_args(seen)


def test_files_that_commands_name_are_there() -> None:
    named = set(re.findall(r"(?<![\w/])((?:deploy|docker)/[\w./-]+)", INDENTED)) - {"deploy/.env"}
    assert {"deploy/compose.postgres.yaml", "deploy/kubernetes/overlays/shared"} <= named
    for name in named:
        assert (DEPLOY.parent / name).exists(), name
    for row in re.findall(r"^\| (`(?:overlays|components|base|weights).*?) \|", README, re.MULTILINE):
        for folder in re.findall(r"`([\w/]+)`", row):
            assert (DEPLOY / "kubernetes" / folder / "kustomization.yaml").is_file()


def test_every_part_of_the_manifests_is_in_the_table() -> None:
    there = {
        str(path.parent.relative_to(DEPLOY / "kubernetes"))
        for path in (DEPLOY / "kubernetes").rglob("kustomization.yaml")
    }
    told = {
        name
        for row in re.findall(r"^\| (`(?:overlays|components|base|weights).*?) \|", README, re.MULTILINE)
        for name in re.findall(r"`([\w/]+)`", row)
    }
    assert told == there


def test_settings_that_are_named_exist() -> None:
    variables = {name.removeprefix("MAPLESS_").lower() for name in re.findall(r"MAPLESS_[A-Z_]+[A-Z]", README)}
    assert "database_url" in variables
    assert variables <= set(Settings.model_fields)


def test_the_urls_are_taken_and_do_not_show() -> None:
    urls = re.findall(r"postgresql://[^\s'`]+", README)
    assert len(urls) >= 3
    for url in urls:
        loaded = load_settings({"database_url": url})
        assert loaded.settings.database_url is not None
        assert loaded.settings.database_url.get_secret_value() == url
        assert url not in str(loaded)


def test_figures_about_the_database_hold() -> None:
    text = " ".join(README.split())
    assert f"A server keeps {CONNECTIONS_KEPT} and opens {CONNECTIONS_AT_MOST} at most" in text
    assert f"calls wait for up to {CONNECTION_WAIT_S:.0f} s" in text
    reserved = 3  # of PostgreSQL's connections, for superusers
    assert (5 + 1) * CONNECTIONS_AT_MOST + reserved <= 100 < (6 + 1) * CONNECTIONS_AT_MOST + reserved
    assert "100 is enough for five" in text
    assert f"come back after {RETRY_AFTER_S:.0f} s" in text
    assert Unavailable.code in text
