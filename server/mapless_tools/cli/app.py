"""The command `mapless-server`: all its commands, and which extra each of the tools needs."""

import functools
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from mapless_command.installation import how_to_install
from mapless_server import __version__
from mapless_server.extras import missing_package
from mapless_server.serve.command import fail, serve_command
from mapless_tools.draw.command import draw_command
from mapless_tools.evaluate.cli import evaluate_command
from mapless_tools.extend.command import extend_command
from mapless_tools.gateway.command import gateway_command
from mapless_tools.ingest.command import ImportCommand, export_command, import_command
from mapless_tools.reconstruct.command import reconstruct_command
from mapless_tools.replay.command import replay_bag_command, replay_command
from mapless_tools.report.command import report_command
from mapless_tools.view.command import view_command

from .audit import audit_command
from .demo import demo_command
from .store import store_app
from .tokens import token_app
from .weights import weights_app

app = typer.Typer(
    help="Visual localization without a map, as a gRPC service.",
    no_args_is_help=True,
    # A traceback with local variables would print image bytes and secrets.
    pretty_exceptions_show_locals=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"mapless-server {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


def _add_tool(
    name: str, command: Callable[..., None], extra: str = "tools", cls: type[TyperCommand] | None = None
) -> None:
    """Adds a command that first checks whether the packages of its extra are installed."""

    @functools.wraps(command)
    def checked(**arguments: Any) -> None:
        _require(extra, name)
        command(**arguments)

    app.command(name, cls=cls)(checked)


def _require(extra: str, command: str) -> None:
    if package := missing_package(extra):
        fail(f"{command} needs the Python package {package}: {how_to_install(extra)}")


class _ServeCommand(TyperCommand):
    """Says what the server has in place of the flag of its clients."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if any(it.partition("=")[0] == "--address" for it in args):
            fail("serve has no --address, which is the client's: give --host and --port")
        return super().parse_args(ctx, args)


app.command("serve", cls=_ServeCommand)(serve_command)
app.add_typer(store_app, name="store")
app.add_typer(token_app, name="token")
app.add_typer(weights_app, name="weights")
_add_tool("import", import_command, cls=ImportCommand)
_add_tool("export", export_command)
_add_tool("reconstruct", reconstruct_command, extra="reconstruct", cls=ImportCommand)
_add_tool("extend", extend_command, extra="reconstruct")
_add_tool("audit", audit_command)
_add_tool("draw", draw_command)
_add_tool("evaluate", evaluate_command)
_add_tool("replay", replay_command)
_add_tool("replay-bag", replay_bag_command)
_add_tool("report", report_command)
_add_tool("view", view_command, extra="view")
_add_tool("gateway", gateway_command, extra="gateway")
_add_tool("demo", demo_command)
