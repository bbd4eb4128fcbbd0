"""`mapless-server report`: the page of how photographs of a scene were answered."""

from __future__ import annotations

from argparse import ArgumentTypeError
from datetime import date
from pathlib import Path
from typing import Annotated

import typer

from mapless_server.serve.command import fail
from mapless_tools.connection import Connection, Scene, with_flags

MOST_DRAWN = 5000
"""References without photographs on a plan."""


def _day(text: str) -> date:
    """A day of a flag; the same words as of the client's command."""
    from mapless.cli.report import day_of

    try:
        return day_of(text)
    except ArgumentTypeError as error:
        raise typer.BadParameter(str(error)) from None


@with_flags
def report_command(
    scene: Scene,
    html: Annotated[Path, typer.Option(help="HTML file to write.")] = Path("report.html"),
    weeks: Annotated[int, typer.Option(min=1, max=500, help="So many weeks.")] = 4,
    since: Annotated[
        date | None, typer.Option(parser=_day, metavar="DAY", help="First day, UTC, instead of --weeks.")
    ] = None,
    until: Annotated[
        date | None, typer.Option(parser=_day, metavar="DAY", help="Last day, UTC; default: today.")
    ] = None,
    *,
    connection: Connection,
) -> None:
    """Draw where photographs of a scene fail, and where references would help, as one HTML page.

    A plan from above with what became of the photographs at each place, charts by week, and numbered suggestions. The
    page loads nothing and runs no scripts. `mapless scene report` prints the same as text.
    """
    from itertools import islice

    from mapless_server.serve.signals import terminable
    from mapless_server.settings import load_settings
    from mapless_tools.connection import connected
    from mapless_tools.output_files import check_writable
    from mapless_tools.usage import failures_end_command

    if since is not None and until is not None and since > until:
        fail(f"--since {since} is after --until {until}")
    with failures_end_command(ValueError):
        from .asking import report_of_weeks

        check_writable(html)
        with terminable(), connected(connection, load_settings({}).settings) as client:
            report = report_of_weeks(client, scene, weeks, until, since)
            known = client.get_scene(scene)
            references = list(islice(client.list_references(scene), MOST_DRAWN))
        from .page import report_page

        page = report_page(report, known, references, known.reference_count - len(references))
        html.write_text(page, encoding="utf-8")
    print(f"the page is in {html}")
