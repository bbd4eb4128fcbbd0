"""`mapless-server audit`: examines the references of a scene on a server and prints what it found, the worst first."""

from __future__ import annotations

import signal
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapless_server.serve.command import fail
from mapless_tools.connection import Connection, Scene, with_flags

from .printing import AsJson, printed_as_json

if TYPE_CHECKING:
    from rich.table import Table

    from mapless import Client, ReferenceAudit, RigidTransform
    from mapless import Scene as KnownScene

ALARMS = (
    "SWAPPED_IMAGE",
    "WRONG_POSE_AND_INTRINSICS",
    "WRONG_POSE",
    "WRONG_INTRINSICS",
    "SCENE_CHANGED",
    "WRONG_DEPTH",
)
"""Findings that cause wrong poses, the worst first."""
MAX_PAGE = 100
COMPARED = 1000
"""References whose poses are compared with what is known of the scene."""
MAX_TIMEOUT_S = 600.0
"""The default of the server's setting max_deadline_s."""
_ORDER = (*ALARMS, "DOUBTFUL_DEPTH", "DUPLICATE", "UNVERIFIABLE", "CONSISTENT")


@with_flags
def audit_command(
    scene: Scene,
    report: Annotated[Path | None, typer.Option(help="JSON file for the whole report.")] = None,
    html: Annotated[Path | None, typer.Option(help="HTML file for the whole report.")] = None,
    page_size: Annotated[int, typer.Option(help="References a call, 1 to 100; each takes up to a second.")] = 10,
    everything: Annotated[bool, typer.Option("--all", help="Print consistent references, too.")] = False,
    as_json: AsJson = None,
    *,
    connection: Connection,
) -> None:
    """Examine the references of a scene against their neighbours; exit code 1 when any of them is wrong, or all.

    Findings are also reported if it ends early: exit code 1 after an error, 130 after Ctrl-C.
    """
    from mapless import MaplessError
    from mapless_server.serve.signals import terminable
    from mapless_server.settings import ConfigError, load_settings
    from mapless_tools.child import ServerFailed
    from mapless_tools.connection import connected
    from mapless_tools.output_files import check_writable
    from mapless_tools.progress import progress_bars

    examined = Examined(scene)
    try:
        for file in filter(None, (report, html)):
            check_writable(file)
        settings = load_settings({}).settings
        with terminable(), connected(connection, settings) as client, progress_bars() as progress:
            known = client.get_scene(scene)
            examined.total = known.reference_count
            examined.of_poses = warnings_of(client, known)
            examined.see(known)
            progress("audit", 0, examined.total)
            for found in client.audit_scene(scene, page_size=page_size, timeout_s=timeout_s(page_size)):
                examined.audits.append(found)
                progress("audit", len(examined.audits), examined.total)
            examined.see(client.get_scene(scene))  # again: meanwhile more of its pairs have been compared
    except (ValueError, ConfigError) as error:
        fail(str(error), code=2)
    except (MaplessError, ServerFailed) as error:
        examined.stopped = str(error)
        print(f"mapless-server: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        examined.stopped = "interrupted"
        raise typer.Exit(128 + signal.SIGINT) from None
    except SystemExit:
        examined.stopped = "terminated"
        raise
    finally:
        if examined.total is not None:
            _report(examined, everything, report, html, as_json)
    if examined.contradiction or any(a.verdict in ALARMS for a in examined.audits):
        raise typer.Exit(1)


@dataclass
class Examined:
    """The findings of an audit, and why it ended early.

    `of_poses` are warnings of what contradicts the references' poses alone, `of_scene` those of the server;
    `contradiction` is the one that says that the scene contradicts itself, and empty if none does. Of `compared_pairs`
    pairs of references, `agreeing_pairs` agree with their poses.
    """

    scene: str
    audits: list[ReferenceAudit] = field(default_factory=list)
    total: int | None = None
    stopped: str = ""
    of_poses: list[str] = field(default_factory=list)
    of_scene: tuple[str, ...] = ()
    contradiction: str = ""
    compared_pairs: int = 0
    agreeing_pairs: int = 0

    @property
    def warnings(self) -> list[str]:
        """All warnings; that the scene contradicts itself comes first."""
        others = [*self.of_poses, *(it for it in self.of_scene if it != self.contradiction)]
        return [self.contradiction, *others] if self.contradiction else others

    def see(self, known: KnownScene) -> None:
        """Takes over what the server says of the scene now."""
        self.of_scene, self.contradiction = known.warnings, known.contradiction
        self.compared_pairs, self.agreeing_pairs = known.compared_pair_count, known.agreeing_pair_count


def warnings_of(client: Client, known: KnownScene) -> list[str]:
    """Contradictions of a scene's datum, down and unit and the poses of its first references by id."""
    from mapless import DataLoss
    from mapless_server.scenes.plausibility import contradictions
    from mapless_server.store import SceneAttributes

    attributes = SceneAttributes(known.datum, known.down_in_world, arbitrary_unit=known.arbitrary_unit)
    poses: list[RigidTransform] = []
    references = client.list_references(known.scene_id, page_size=COMPARED)
    with suppress(DataLoss):  # the audit names what is damaged
        poses.extend(reference.world_from_camera for reference in islice(references, COMPARED))
    return contradictions(poses, attributes)


def timeout_s(page_size: int) -> float:
    """Deadline of a page: some seconds, and three times the longest time of a reference, up to the server's limit."""
    return min(5.0 + 3.0 * (page_size or MAX_PAGE), MAX_TIMEOUT_S)


def _report(examined: Examined, everything: bool, report: Path | None, html: Path | None, as_json: bool | None) -> None:
    from rich.console import Console

    from mapless_tools.output_files import write_json

    examined = replace(examined, audits=worst_first(examined.audits))
    shown = [a for a in examined.audits if everything or a.verdict != "CONSISTENT"]
    console = Console(soft_wrap=True)
    if not printed_as_json(as_json, to_json(examined)):
        for warning in examined.warnings:
            kind = "wrong" if warning == examined.contradiction else "warning"
            console.print(f"{kind}: {warning}", markup=False, highlight=False)
        if shown:
            Console().print(table_of(shown))
            for audit in shown:
                console.print(f"{reference_id_of(audit)}: {audit.message}", markup=False, highlight=False)
        console.print(summary_of(examined), markup=False)
        console.print(pairs_of(examined), markup=False)
    if report is not None:
        write_json(report, to_json(examined))
    if html is not None:
        html.write_text(to_html(examined), encoding="utf-8")


def worst_first(audits: Iterable[ReferenceAudit]) -> list[ReferenceAudit]:
    """Sorts audits by finding, then by offset, then by name."""
    return sorted(audits, key=lambda a: (_rank(a.verdict), -a.position_offset_m, -a.rotation_offset_deg, a.name))


def _rank(verdict: str) -> int:
    return _ORDER.index(verdict) if verdict in _ORDER else len(_ORDER)


def summary_of(examined: Examined) -> str:
    """The number of each finding, in one line."""
    counts = Counter(a.verdict for a in examined.audits)
    parts = [f"{counts[v]} {v.lower().replace('_', ' ')}" for v in sorted(counts, key=_rank)]
    found = f"{len(examined.audits)} references: {', '.join(parts) or 'none'}"
    if not examined.stopped:
        return found
    return f"stopped after {len(examined.audits)} of {examined.total} references ({examined.stopped}); {found}"


def pairs_of(examined: Examined) -> str:
    """How the pairs of a scene's references agree with their poses, in one line."""
    if not examined.compared_pairs:
        return "too little overlap: no two references show enough in common to compare their poses"
    counts = f"{examined.agreeing_pairs} of {examined.compared_pairs} pairs of references agree with their poses"
    return f"{counts}: the scene contradicts itself" if examined.contradiction else counts


def reference_id_of(audit: ReferenceAudit) -> str:
    """The reference's id within its scene."""
    return audit.name.rsplit("/", 1)[-1]


def cells_of(audit: ReferenceAudit) -> tuple[str, ...]:
    """The figures of one reference, in the order of `COLUMNS`; a dash for an unknown one."""
    is_known = audit.focal_ratio > 0
    return (
        reference_id_of(audit),
        audit.verdict.lower().replace("_", " "),
        f"{100 * audit.position_offset_m:.1f}" if is_known else "-",
        f"{audit.rotation_offset_deg:.2f}" if is_known else "-",
        f"{100 * (1 / audit.focal_ratio - 1):+.1f}" if is_known else "-",
        f"{audit.inlier_count}/{audit.match_count}",
        f"{audit.reprojection_error_px:.1f}" if audit.reprojection_error_px else "-",
        _placed_within(audit),
        audit.message,
    )


def _placed_within(audit: ReferenceAudit) -> str:
    accuracy = audit.provenance.accuracy
    return "-" if accuracy is None else f"{100 * accuracy.position_95_m:.2g}"


COLUMNS = (
    "reference",
    "finding",
    "off, cm",
    "turned, deg",
    "focal, %",
    "agree",
    "error, px",
    "placed within, cm",
    "in words",
)


def table_of(audits: Sequence[ReferenceAudit]) -> Table:
    """The table for a terminal: figures only, because messages would not fit."""
    from rich.table import Table

    table = Table()
    for i, column in enumerate(COLUMNS[:-1]):
        table.add_column(column, justify="right" if 2 <= i <= 7 else "left", overflow="fold")
    for audit in audits:
        style = "red" if audit.verdict in ALARMS else "" if audit.verdict == "CONSISTENT" else "yellow"
        table.add_row(*cells_of(audit)[:-1], style=style)
    return table


def to_json(examined: Examined) -> dict[str, Any]:
    """The report for programs; `stopped` says why it ended early and is empty if it did not."""
    return {
        "scene": examined.scene,
        "summary": summary_of(examined),
        "stopped": examined.stopped,
        "contradiction": examined.contradiction,
        "compared_pairs": examined.compared_pairs,
        "agreeing_pairs": examined.agreeing_pairs,
        "warnings": examined.warnings,
        "reference_count": examined.total,
        "references": [asdict(a) for a in examined.audits],
    }


def to_html(examined: Examined) -> str:
    """The report as one self-contained page."""
    from mapless_tools.output_files import render

    kinds = ["alarm" if a.verdict in ALARMS else "" if a.verdict == "CONSISTENT" else "note" for a in examined.audits]
    return render(
        "audit.html",
        title=f"Audit of scene {examined.scene}",
        summary="; ".join([summary_of(examined), *examined.warnings]),
        columns=COLUMNS,
        rows=map(cells_of, examined.audits),
        kinds=kinds,
    )
