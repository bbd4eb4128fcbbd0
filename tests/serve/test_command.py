"""`mapless-server serve` has a flag for each setting; the commands of the server run without the tools' packages."""

import pytest
import typer.main
from support.programs import printed
from support.project import PROJECT
from typer.testing import CliRunner

from mapless_command.installation import how_to_install
from mapless_server import extras
from mapless_server.extras import install_hint
from mapless_server.settings import Settings, bounds_text, default_text
from mapless_tools.cli import app as commands

TOOLS = {
    "import": ["folder", "scene"],
    "export": ["scene", "folder"],
    "audit": ["scene"],
    "draw": ["answers", "photo"],
    "evaluate": ["folder"],
    "replay": ["folder"],
    "replay-bag": ["recording", "scene", "out"],
    "reconstruct": ["photographs", "out"],
    "extend": ["scene", "photographs"],
    "report": ["scene"],
    "view": ["scene"],
    "gateway": [],
    "demo": [],
}
"""The commands that need an extra, with the arguments that they must be given."""


def test_serve_has_a_flag_for_each_setting_but_secrets() -> None:
    group = typer.main.get_command(commands.app)
    serve = vars(group)["commands"]["serve"]
    assert {it.name for it in serve.params} == set(Settings.model_fields) - {"database_url"} | {"config"}
    assert {flag for it in serve.params for flag in it.secondary_opts} >= {"--no-metrics", "--no-warm-up"}


def test_help_shows_bound_and_default_of_each_setting() -> None:
    shown = {it.name: str(it.help) for it in vars(typer.main.get_command(commands.app))["commands"]["serve"].params}
    assert shown["max_batch"].endswith("(1 to 64; default: 4)")
    for name in set(shown) - {"config"}:
        assert bounds_text(name) in shown[name]
        assert not default_text(name) or f"default: {default_text(name)})" in shown[name]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--port", "65536"], "mapless-server: port (flag): "),
        (["--coverage", "1"], "mapless-server: coverage (flag): "),
        (["--features", "surf"], "mapless-server: features (flag): must be one of auto, sift, "),
        (["--log-level", "loud"], "mapless-server: log_level (flag): "),
        (
            ["--address", "0.0.0.0:50051"],
            "mapless-server: serve has no --address, which is the client's: give --host and",
        ),
        (["--config", "absent.toml"], "mapless-server: absent.toml: no such file"),
    ],
)
def test_a_wrong_flag_ends_serve_with_one_line(flags: list[str], message: str) -> None:
    ended = CliRunner().invoke(commands.app, ["serve", *flags])
    assert (ended.exit_code, ended.stderr.count("\n")) == (2, 1)
    assert ended.stderr.startswith(message)


@pytest.mark.parametrize("name", TOOLS)
def test_a_tool_without_its_packages_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "missing_package", lambda extra: "absent")
    ended = CliRunner().invoke(commands.app, [name, *TOOLS[name]])
    extra = {"extend": "reconstruct"}.get(name, name if name in ("view", "gateway", "reconstruct") else "tools")
    assert ended.exit_code == 2
    assert ended.stderr == f"mapless-server: {name} needs the Python package absent: {how_to_install(extra)}\n"


def test_every_command_either_serves_or_needs_an_extra() -> None:
    names = set(vars(typer.main.get_command(commands.app))["commands"])
    assert names == {"serve", "store", "token", "weights", *TOOLS}


@pytest.mark.parametrize("module", ["mapless_tools.cli.app", "mapless_server.serve.command"])
def test_help_imports_nothing_heavy(module: str) -> None:
    heavy = ("cv2", "grpc", "jinja2", "matplotlib", "numpy", "scipy", "sqlalchemy", "torch")
    assert printed(f"import sys, {module}; print([it for it in {heavy} if it in sys.modules])") == "[]\n"


DISTRIBUTION_OF = {
    "opentelemetry": "opentelemetry-sdk",
    "pillow_heif": "pillow-heif",
    "python_multipart": "python-multipart",
}


def test_every_extra_brings_its_packages() -> None:
    brought = PROJECT["optional-dependencies"]
    for package, extra in extras._EXTRA_OF.items():
        distribution = DISTRIBUTION_OF.get(package, package)
        assert any(requirement.startswith(f"{distribution}>=") for requirement in brought[extra]), package


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        (
            ModuleNotFoundError("No module named 'transformers'", name="transformers"),
            f"the Python package transformers is not installed: {how_to_install('superpoint')}",
        ),
        (
            ModuleNotFoundError("No module named 'kornia.feature.xfeat'", name="kornia.feature.xfeat"),
            f"No module named 'kornia.feature.xfeat': {how_to_install('networks')}",
        ),
        (
            ModuleNotFoundError("No module named 'scipy'", name="scipy"),
            f"the Python package scipy is not installed: {how_to_install('server')}",
        ),
        (ImportError("libGL.so.1: cannot open"), "libGL.so.1: cannot open"),
    ],
)
def test_a_hint_names_the_fault_and_the_command(error: ImportError, hint: str) -> None:
    assert install_hint(error) == hint
