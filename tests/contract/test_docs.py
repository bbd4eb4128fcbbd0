"""The pages are true: links, commands, Python, tables, settings, metrics and figures."""

import ast
import asyncio
import importlib
import re
from fnmatch import fnmatch
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
from prometheus_client import generate_latest
from support.bags import compressed, info
from support.documents import PAGES, ROOT, anchors, blocks, commands, prose, shell, written
from support.images import encode, textured
from support.servers import pose, serving
from test_imports import LADDER

from mapless import Camera, Client, NewReference, RigidTransform, pixels
from mapless import errors as client_errors
from mapless.cli.arguments import make_parser
from mapless.connection import MALFORMED_ANSWER
from mapless.v1 import localization_service_pb2 as pb
from mapless_server import errors
from mapless_server.errors import Unavailable
from mapless_server.method.features.extractors import SiftOptions
from mapless_server.method.features.views import Features, View
from mapless_server.method.options import Variant
from mapless_server.method.rejection import RejectionReason
from mapless_server.observability.metrics import Metrics
from mapless_server.scheduling import Refusal
from mapless_server.settings import CLIENT_ADDRESS_VARIABLE, CLIENT_TOKEN_VARIABLE, Settings, load_settings
from mapless_server.store.codec import encode_view
from mapless_server.store.database import RETRY_AFTER_S
from mapless_server.store.postgresql import CONNECTION_WAIT_S, CONNECTIONS_AT_MOST, CONNECTIONS_KEPT
from mapless_tools.cli.app import app

SERVER, CLIENT = Path(errors.__file__).parent, Path(client_errors.__file__).parent
DOCS, DEPLOY = ROOT / "docs", ROOT / "deploy"
CURRENT = "\n".join(written(page) for page in PAGES if page.name != "CHANGELOG.md")


def page_id(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) < 220


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(#[^)\s]*)?\)", prose(page)):
        if ":" not in target:
            there = page if not target else (page.parent / target).resolve()
            assert there.exists(), target
            assert there.is_relative_to(ROOT)
            assert not anchor or anchor[1:] in anchors(there), f"{target}{anchor}"


# Commands


def test_client_commands_parse() -> None:
    seen = list(commands("mapless"))
    assert len(seen) >= 15
    for _, arguments in seen:
        make_parser().parse_args(arguments)  # exits where it does not understand


def test_server_commands_parse() -> None:
    group = typer.main.get_command(app)
    seen = list(commands("mapless-server", before="(?:docker|kubectl) .* "))
    assert len(seen) >= 35
    for _, arguments in seen:
        command, rest = group, arguments
        context = typer.Context(command)
        while hasattr(command, "resolve_command"):
            _, command, rest = command.resolve_command(context, rest)
            context = typer.Context(command, parent=context)
        command.parse_args(context, rest)  # raises where it does not understand


def test_make_targets_exist() -> None:
    there = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {target for _, (target, *_) in commands("make")} | set(re.findall(r"`make ([a-z-]+)", CURRENT))
    assert "demo" in named
    assert named <= there


def test_modules_that_are_run_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "server")
    named = set(re.findall(r"python -m\s+((?:mapless|research|bench)[\w.]*)", CURRENT))
    assert len(named) >= 3
    assert sorted(name for name in named if find_spec(name) is None) == []


def test_the_table_of_extras_is_complete() -> None:
    listed = re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text().split("optional-dependencies]")[1], re.M)
    named = [name for row in rows(DOCS / "operation/server.md", "extra") for name in row]
    assert {*listed[: listed.index("dev") + 1]} <= {*named}


def test_files_that_commands_and_text_name_exist() -> None:
    shown = "\n".join(map(shell, PAGES))
    named = set(re.findall(r"(?<![\w/.])((?:deploy|docker|proto|client)/[\w./-]+)", shown))
    assert {"deploy/compose.postgres.yaml", "deploy/kubernetes/overlays/shared"} <= named
    named |= set(re.findall(r"`((?:client|deploy|docker|docs|proto|server|tests)/[\w./-]+)`", CURRENT))
    made = {"deploy/.env", "client/web/dist"}  # by the reader
    assert sorted(name for name in named - made if not (ROOT / name).exists()) == []
    tests = set(re.findall(r"`((?!tests/)[a-z]+/test_\w+\.py)`", CURRENT))
    assert len(tests) >= 8
    assert sorted(name for name in tests if not (ROOT / "tests" / name).exists()) == []


@pytest.mark.parametrize("page", sorted((DOCS / "architecture").iterdir()), ids=page_id)
def test_architecture_names_files_that_exist(page: Path) -> None:
    bases = [ROOT, SERVER, SERVER / "method"]
    for name in re.findall(r"`([\w./]+(?:\.py|/))`", page.read_text()):
        assert any((base / name).exists() for base in bases), name


def test_architecture_names_types_that_exist() -> None:
    """Classes of the server, or messages and methods of the interface."""
    text = "".join(page.read_text() for page in (DOCS / "architecture").iterdir())
    paths = (*SERVER.rglob("*.py"), *CLIENT.glob("*.py"), *(ROOT / "proto").rglob("*.proto"))
    sources = "".join(path.read_text() for path in paths)
    named = set(re.findall(r"`([A-Z][a-z]\w+)`", text))
    assert {"Search", "LocalizeRequest"} <= named
    assert sorted(name for name in named if not re.search(rf"(class|message|rpc) {name}\b", sources)) == []


def test_the_table_of_rooms_is_the_ladder_of_imports() -> None:
    table = re.findall(r"^\| `(\w+)` \|.*\|(.*)\|$", (DOCS / "architecture/rooms.md").read_text(), re.MULTILINE)
    assert [room for room, _ in table] == list(LADDER)
    for room, begin in table:
        for name in re.findall(r"`([\w.]+)`", begin):
            module, _, attribute = name.partition(".")
            loaded = importlib.import_module(f"mapless_server.{room}.{module}")
            assert not attribute or hasattr(loaded, attribute), name


# Python


def run(program: str, known: dict[str, Any]) -> None:
    """Runs a block, which may await."""
    code = compile(program, "page", "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    result = eval(code, known)
    if result is not None:
        asyncio.run(result)


def test_the_python_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One block after the other, with what the text around them takes as given."""
    first, *others = [block for page in PAGES for block in blocks(page, "python")]
    assert len(others) >= 7
    photo = encode(".jpg", textured(1600, 1067))
    for name in ("a", "b", "query", "photo", "left", "right"):
        (tmp_path / f"{name}.jpg").write_bytes(photo)
    monkeypatch.chdir(tmp_path)
    with serving(tmp_path / "data") as server:
        monkeypatch.setenv("MAPLESS_ADDRESS", server.address)
        known: dict[str, Any] = {
            "poses": {"a": pose(0.0).matrix(), "b": pose(1.0).matrix()},
            "xyz": pose(0.0).translation,
            "depth_m": np.full((1067, 1600), 1.5, np.float32),
            "world_from_camera": pose(2.0),
            "down_in_camera": np.array([0.0, 1.0, 0.0]),
            "rig_from_left": RigidTransform.identity(),
            "rig_from_right": pose(0.5),
            "tracked": pose(0.0),
            "odometry_since": RigidTransform.identity(),
            "covariance_since": 1e-4 * np.eye(6),
            "walk": [("a.jpg", pose(0.0)), ("b.jpg", pose(1.0))],
            "lookup": lambda target, source, stamp_ns: RigidTransform.identity(),
            "image_message": compressed(1_800_000_000_000_000_000, photo),
            "info_message": info(Camera(1600, 1067, 1437.2, 1440.1, 791.8, 524.3)),
        }
        run(first.replace("localhost:50051", server.address), known)
        assert capsys.readouterr().out.startswith("[ 0.  2. -1.] 0.")
        with Client(server.address) as client:
            client.create_scene("kitchen")
            for name, world_from_camera in known["poses"].items():
                pose_of = RigidTransform.from_matrix(world_from_camera)
                client.add_reference("kitchen", NewReference(name, photo, known["camera"], pose_of))
            client.update_scene("hall", down_in_world=(0, 0, -1), labels={"site": "a"})
            for program in others:
                known["client"] = client
                run(program.replace("localhost:50051", server.address), known)


# Tables


def rows(page: Path, heading: str) -> list[list[str]]:
    """The text in backticks in the first two columns of the table with this first heading."""
    (table,) = re.findall(rf"^\| {heading} \|.*\n\|.*\n((?:\|.*\n)+)", written(page), re.MULTILINE)
    return [re.findall(r"`([\w*/]+)`", "|".join(row.split("|")[1:3])) for row in table.splitlines()]


def test_tables_of_rejections_and_variants_are_complete() -> None:
    reasons = [row[0] for row in rows(DOCS / "reference/answers.md", "reason")]
    assert reasons == [reason.name for reason in RejectionReason]
    assert {f"REJECTION_REASON_{name}" for name in reasons} < set(
        pb.DESCRIPTOR.enum_types_by_name["RejectionReason"].values_by_name
    )
    variants = [row[0] for row in rows(DOCS / "guides/researcher.md", "variant")]
    assert variants == [variant.value for variant in Variant]


def test_the_table_of_methods_is_complete() -> None:
    named = [name for row in rows(DOCS / "guides/first-calls.md", "method") for name in row]
    protos = "".join(path.read_text() for path in (ROOT / "proto").rglob("*.proto"))
    assert {name for name in named if name[0].isupper()} == set(re.findall(r"rpc (\w+)\(", protos))
    assert [name for name in named if name.islower() and not hasattr(Client, name)] == []


def test_the_table_of_errors_has_every_reason() -> None:
    """And none that is not; a class's own reason is its status's name, which stands in the table in any case."""
    sources = "".join(path.read_text() for path in (*SERVER.rglob("*.py"), Path(pixels.__file__)))
    there = set(re.findall(r'(?:reason=|BadHeader\(f?".*", )"([A-Z_]+)"', sources))
    there |= {refusal.name for refusal in Refusal} | {MALFORMED_ANSWER}
    assert {"QUEUE_FULL", "IMAGE_UNKNOWN_FORMAT", "TOKEN_EXPIRED", "STORE_FULL"} <= there
    named = {name for row in rows(DOCS / "reference/errors.md", "status") for name in row}
    statuses = set(client_errors._BY_CODE)
    assert statuses <= named
    assert not {reason for reason in there if not any(fnmatch(reason, it) for it in named)}
    assert {it for it in named - statuses if not any(fnmatch(reason, it) for reason in there)} == {"RetryInfo"}


def test_metrics_exist() -> None:
    there = generate_latest(Metrics().registry).decode()
    named = {name for row in rows(DOCS / "operation/server.md", "metric") for name in row if "_" in name}
    assert "mapless_queue_cost_seconds" in named
    for name in named:
        assert re.search(rf"^# TYPE {name} ", there, re.MULTILINE), name


def test_the_table_of_manifests_is_complete() -> None:
    folders = {path.parent for path in (DEPLOY / "kubernetes").rglob("kustomization.yaml")}
    table = re.findall(r"^\| (`(?:overlays|components|base|weights).*?) \|", CURRENT, re.MULTILINE)
    named = {name for row in table for name in re.findall(r"`([\w/]+)`", row)}
    assert named == {str(folder.relative_to(DEPLOY / "kubernetes")) for folder in folders}


# Settings


def test_settings_that_are_named_exist() -> None:
    others = {CLIENT_ADDRESS_VARIABLE, CLIENT_TOKEN_VARIABLE, "MAPLESS_SCENE", "MAPLESS_CONFIG", "MAPLESS_PURE"}
    variables = set(re.findall(r"\bMAPLESS_[A-Z_]+[A-Z]", CURRENT)) - others
    assert "MAPLESS_DATABASE_URL" in variables
    assert {name.removeprefix("MAPLESS_").lower() for name in variables} <= set(Settings.model_fields)


def test_database_urls_are_taken_and_do_not_show() -> None:
    urls = re.findall(r"postgresql://[^\s'`]+", (DOCS / "operation/stores.md").read_text())
    urls += re.findall(r"postgresql://[^\s'`]+", (DOCS / "operation/deployment.md").read_text())
    assert len(urls) >= 3
    for url in urls:
        loaded = load_settings({"database_url": url})
        assert loaded.settings.database_url is not None
        assert loaded.settings.database_url.get_secret_value() == url
        assert url not in str(loaded)


def test_figures_about_the_database_hold() -> None:
    text = " ".join((DOCS / "operation/stores.md").read_text().split())
    assert f"A server keeps {CONNECTIONS_KEPT} and opens {CONNECTIONS_AT_MOST} at most" in text
    assert f"calls wait for up to {CONNECTION_WAIT_S:.0f} s" in text
    reserved = 3  # of PostgreSQL's connections, for superusers
    assert (5 + 1) * CONNECTIONS_AT_MOST + reserved <= 100 < (6 + 1) * CONNECTIONS_AT_MOST + reserved
    assert "100 is enough for five" in text
    assert f"retry after {RETRY_AFTER_S:.0f} s" in text
    assert Unavailable.code in text


def test_a_reference_takes_the_space_that_the_guide_says() -> None:
    """The features of SIFT, and a JPEG of 640x480."""
    (shown,) = re.findall(r"A reference takes about ([\d.]+) MB", (ROOT / "docs/guides/scenes.md").read_text())
    count = SiftOptions().max_keypoints
    features = Features(np.zeros((count, 2), np.float32), np.zeros((count, 128), np.uint8), np.zeros(count, np.float32))
    view = View(Camera.from_fov(640, 480, 70.0), features)
    photograph = encode(".jpg", textured(640, 480))
    assert (len(encode_view(view)) + len(photograph)) / 1e6 == pytest.approx(float(shown), rel=0.1)
