"""The command: vectors, a store that has them, and what a server takes; a table and JSON."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from mapless_server.store import Store

from .measure import make, serve
from .scene import fill
from .vectors import Vectors, photographed, planted

T = TypeVar("T")


def main(
    references: Annotated[int, typer.Option(help="Size of the scene, a multiple of 10,000.")] = 1_000_000,
    queries: Annotated[int, typer.Option(help="Queries that are timed.")] = 2000,
    data: Annotated[Path | None, typer.Option(help="Folder of folders with photographs and cameras.json.")] = None,
    only: Annotated[str, typer.Option(help="planted or photographs; both if empty.")] = "",
    work: Annotated[
        Path | None, typer.Option(help="Folder for stores, about 5 KB a reference; else a temporary one.")
    ] = None,
    output: Annotated[Path, typer.Option(help="File for the figures.")] = Path("bench-output/retrieval.json"),
) -> None:
    """Measures retrieval in a scene of so many references."""
    figures = {}
    sets: dict[str, Callable[[], Vectors]] = {"planted": lambda: planted(references, seed=1)}
    if data is not None:
        sets["photographs"] = lambda: photographed(data, references, seed=1)
    for name, vectors in sets.items():
        if only in ("", name):
            figures[name] = _measure(vectors(), queries, work)
            typer.echo(f"{name}: " + json.dumps(figures[name], indent=2))
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps({"references": references, **figures}, indent=2) + "\n")


def _measure(vectors: Vectors, query_count: int, work: Path | None) -> dict[str, object]:
    folder = Path(tempfile.mkdtemp(dir=work))
    try:
        with Store.open(folder) as store:
            best = fill(store, vectors)
        typer.echo(f"{vectors.title}: the store is filled")
        made = _alone(make, folder, vectors.queries.shape[1])
        served = _alone(serve, folder, vectors.queries, best, query_count)
    finally:
        shutil.rmtree(folder)
    return {"vectors": vectors.title, "queries": len(vectors.queries), **asdict(made), **asdict(served)}


def _alone(function: Callable[..., T], *arguments: object) -> T:
    """The result of a function in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)
