"""`mapless-server replay`: computes captured answers again, and prints the differences."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapless_server.serve.command import fail

if TYPE_CHECKING:
    from .report import Replayed, Report

SHOWN_CHANGES = 12


def replay_command(
    folder: Annotated[Path, typer.Argument(help="A server's capture_dir, or a copy of it.")],
    request_id: Annotated[
        list[str] | None, typer.Option("--id", help="Only the call of this id; again for more.")
    ] = None,
    last: Annotated[int | None, typer.Option(min=1, help="Only so many, the latest.")] = None,
    tenant: Annotated[str, typer.Option(help="Only this tenant's.")] = "",
    scene: Annotated[str, typer.Option(help="Only those in the scene of this id.")] = "",
    json_output: Annotated[bool, typer.Option("--json", help="Everything, as JSON.")] = False,
    config: Annotated[Path | None, typer.Option(help="TOML file of settings; also MAPLESS_CONFIG.")] = None,
    backend: Annotated[str | None, typer.Option(help="As the server's setting.")] = None,
    features: Annotated[str | None, typer.Option(help="As the server's setting.")] = None,
    device: Annotated[str | None, typer.Option(help="As the server's setting.")] = None,
    weights_dir: Annotated[Path | None, typer.Option(help="As the server's setting.")] = None,
) -> None:
    """Compute captured answers again, by this program and its settings; exit code 1 unless all are identical.

    Identical is to the last bit. References are those that were captured, and so is the choice among them; no store is
    read.
    """
    from mapless_server.serve.libraries import configure_libraries
    from mapless_server.settings import ConfigError, load_settings

    flags = {"backend": backend, "features": features, "device": device, "weights_dir": weights_dir}
    try:
        settings = load_settings(flags, config).settings
    except ConfigError as error:
        fail(str(error))
    configure_libraries(settings)

    from mapless_server.services.capture.calls import CaptureError

    from .report import Selection, replay

    try:
        selection = Selection(frozenset(request_id or ()), last, tenant, scene)
        report = replay(folder, selection, settings)
    except CaptureError as error:
        fail(str(error))
    if json_output:
        _print_json(report)
    else:
        _print(report)
    raise typer.Exit(0 if report.is_identical else 1)


def _print_json(report: Report) -> None:
    import json
    from dataclasses import asdict

    print(json.dumps(asdict(report) | {"is_identical": report.is_identical}, indent=2))


def _print(report: Report) -> None:
    for change in report.circumstances:
        print(f"{change.field}: then {change.then}, now {change.now}")
    if report.circumstances:
        print()
    for call in report.calls:
        _print_call(call)
    for fault in report.unreadable:
        print(f"unreadable: {fault}")
    counts = {name: sum(it.verdict == name for it in report.calls) for name in ("identical", "changed", "not computed")}
    counts["unreadable"] = len(report.unreadable)
    print(", ".join(f"{count} {name}" for name, count in counts.items() if count) or "nothing to compare")


def _print_call(call: Replayed) -> None:
    head = f"{call.time} {call.request_id} {call.method} {call.tenant}/{call.scene_id}"
    if call.error:
        print(f"{head}: {call.verdict}, {call.outcome_then} then; now {call.error}")
        return
    print(f"{head}: {call.verdict}, {call.outcome_now}, {call.seconds_then:.2f} s then, {call.seconds_now:.2f} s now")
    if call.found_anew:
        print(f"    this version cannot read the features of {call.found_anew} references, and extracted them again")
    if call.verdict == "identical":
        return
    if call.apart_cm is not None and call.apart_deg is not None:
        print(f"    the poses are {call.apart_cm:.4f} cm and {call.apart_deg:.5f} degrees apart")
    for change in call.changes[:SHOWN_CHANGES]:
        print(f"    {change.field}: {change.then} → {change.now}")
    if len(call.changes) > SHOWN_CHANGES:
        print(f"    and {len(call.changes) - SHOWN_CHANGES} more, see --json")
