"""`mapless-server report`: the page of how photographs of a scene were answered."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from mapless_server.serve.command import fail
from mapless_tools.connection import Connection, Scene, with_flags

MOST_DRAWN = 5000
"""References without photographs on a plan."""
_DAY = ["%Y-%m-%d"]


@with_flags
def report_command(
    scene: Scene,
    html: Annotated[Path, typer.Option(help="HTML file to write.")] = Path("report.html"),
    weeks: Annotated[int, typer.Option(min=1, max=500, help="So many weeks.")] = 4,
    since: Annotated[datetime | None, typer.Option(formats=_DAY, help="First day, UTC, instead of --weeks.")] = None,
    until: Annotated[datetime | None, typer.Option(formats=_DAY, help="Last day, UTC; default: today.")] = None,
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
        fail(f"--since {since:%Y-%m-%d} is after --until {until:%Y-%m-%d}")
    with failures_end_command(ValueError):
        from .asking import report_of_weeks

        check_writable(html)
        with terminable(), connected(connection, load_settings({}).settings) as client:
            last = until.date() if until is not None else None
            if since is None:
                report = report_of_weeks(client, scene, weeks, last)
            else:
                report = client.get_scene_report(scene, first_day=since.date(), last_day=last)
            known = client.get_scene(scene)
            references = list(islice(client.list_references(scene), MOST_DRAWN))
        from .page import report_page

        page = report_page(report, known, references, known.reference_count - len(references))
        html.write_text(page, encoding="utf-8")
    print(f"the page is in {html}")
