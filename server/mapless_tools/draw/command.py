"""`mapless-server draw`: pages of answers."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapless_tools.connection import Connection, with_flags

if TYPE_CHECKING:
    from mapless import Client, LocalizationResult, Reference, Rejected

MAX_REFERENCES = 16
"""References of an answer on its plan."""


@with_flags
def draw_command(
    answers: Annotated[
        Path, typer.Argument(help="File that `mapless localize --debug --output FILE` wrote; - for standard input.")
    ],
    photo: Annotated[Path, typer.Argument(help="The photograph, or the folder of photographs, that was localized.")],
    output: Annotated[Path, typer.Option(help="Folder for the pages, one for each photograph.")] = Path("pages"),
    *,
    connection: Connection,
) -> None:
    """Draw answers as HTML pages: the photograph with its matches, the best references, the plan, and the figures.

    A page has less than 5 MB, loads nothing and runs no scripts. The references come from the server.
    """
    from mapless_server.serve.signals import terminable
    from mapless_server.settings import load_settings
    from mapless_tools.connection import connected
    from mapless_tools.plan import down_of
    from mapless_tools.usage import failures_end_command

    from .answers import read_answers
    from .page import answer_page

    with failures_end_command(ValueError):
        text = sys.stdin.read() if str(answers) == "-" else answers.read_text(encoding="utf-8")
        written = [(it, _photo_of(photo, it.photo)) for it in read_answers(text, str(answers))]
        output.mkdir(parents=True, exist_ok=True)
        settings = load_settings({}).settings
        with terminable(), connected(connection, settings) as client:
            for it, file in written:
                references = list(references_of(client, it.answer))
                scene = client.get_scene(references[0].scene_id) if references else None
                poses = [reference.world_from_camera for reference in references]
                down = down_of(scene, poses) if references else None
                page = answer_page(it.photo, it.answer, file.read_bytes(), it.camera, references, down)
                (output / f"{it.photo.replace('/', '_')}.html").write_text(page, encoding="utf-8")
    print(f"{len({it.photo for it, _ in written})} pages are in {output}")


def references_of(client: Client, answer: LocalizationResult | Rejected) -> Iterator[Reference]:
    """Fetches the references of an answer, the best with their photographs; passes over those that are deleted."""
    from mapless import NotFound
    from mapless.names import parse_reference_name

    from .page import best_references

    best = best_references(answer)
    uses = sorted(answer.diagnostics.references, key=lambda use: (-use.inlier_count, -use.match_count))
    names = dict.fromkeys([*best, *(use.name for use in uses if use.match_count)])
    for name in list(names)[:MAX_REFERENCES]:
        with suppress(NotFound):
            yield client.get_reference(*parse_reference_name(name), include_image=name in best)


def _photo_of(given: Path, name: str) -> Path:
    """The photograph of an answer; ValueError if there is none of that name."""
    file = given / name if given.is_dir() else given
    if file.name != Path(name).name:
        raise ValueError(f"the answer is of {name}, not of {given}")
    if not file.is_file():
        raise ValueError(f"{file}, of which an answer is, is not there")
    return file
