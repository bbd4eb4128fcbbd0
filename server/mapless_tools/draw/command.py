"""`mapless-server draw`: pages of answers."""

from __future__ import annotations

import itertools
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from mapless_tools.connection import Connection, with_flags


@with_flags
def draw_command(
    answers: Annotated[
        Path, typer.Argument(help="File that `mapless localize --debug --output FILE` wrote; - for standard input.")
    ],
    photo: Annotated[Path, typer.Argument(help="The photograph, or the folder of photographs, that was localized.")],
    output: Annotated[
        Path, typer.Option(help="Folder for the pages, one for each answer, in the sub-folders of the photographs.")
    ] = Path("pages"),
    *,
    connection: Connection,
) -> None:
    """Draw answers as HTML pages: the photograph with its matches, the best references, the plan, and the figures.

    A page has less than 5 MB, loads nothing and runs no scripts. The references come from the server, which is asked
    only for answers that name some; without it the pages have no references, and say so.
    """
    from mapless_server.serve.signals import terminable
    from mapless_tools.usage import failures_end_command

    from .answers import read_answers
    from .page import answer_page
    from .references import ReferenceSource

    with failures_end_command(ValueError):
        text = sys.stdin.read() if str(answers) == "-" else answers.read_text(encoding="utf-8")
        written = [(it, _photo_of(photo, it.photo)) for it in read_answers(text, str(answers))]
        missing: set[str] = set()
        taken: set[str] = set()
        with terminable(), ExitStack() as stack:
            source = ReferenceSource(connection, stack)
            for it, file in written:
                found = source.find(it.answer)
                if found.missing and found.missing not in missing:
                    print(f"mapless-server: {found.missing}", file=sys.stderr)
                    missing.add(found.missing)
                page = output / f"{_free_name(it.photo, taken)}.html"
                page.parent.mkdir(parents=True, exist_ok=True)
                html = answer_page(
                    it.photo,
                    it.answer,
                    file.read_bytes(),
                    it.camera,
                    found.references,
                    found.down_in_world,
                    missing=found.missing,
                )
                page.write_text(html, encoding="utf-8")
    print(f"1 page is in {output}" if len(written) == 1 else f"{len(written)} pages are in {output}")


def _free_name(photo: str, taken: set[str]) -> str:
    """A photograph's name, -2 and so on behind it where another answer has it; adds it to those that are taken.

    Names that differ in case alone are one on some disks.
    """
    names = itertools.chain([photo], (f"{photo}-{number}" for number in itertools.count(2)))
    name = next(it for it in names if it.casefold() not in taken)
    taken.add(name.casefold())
    return name


def _photo_of(given: Path, name: str) -> Path:
    """The photograph of an answer; ValueError if there is none of that name."""
    file = given / name if given.is_dir() else given
    if file.name != Path(name).name:
        raise ValueError(f"the answer is of {name}, not of {given}")
    if not file.is_file():
        raise ValueError(f"{file}, of which an answer is, is not there")
    return file
