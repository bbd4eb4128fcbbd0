"""A run of the command: the server, the sources, the folder that an interrupted run continues, and the report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mapless_server.serve.signals import terminable
from mapless_server.settings import Settings
from mapless_tools.connection import Connection, connected
from mapless_tools.output_files import write_json
from mapless_tools.progress import progress_bars
from mapless_tools.reconstruct.folder import full_disk_named, locked
from mapless_tools.reconstruct.run import prepare
from mapless_tools.reconstruct.sources import SourceOptions, read_sources

from .existing import check_scene, surveyed_of
from .options import ExtendOptions
from .report import lines, to_json, went_well
from .run import extend, store


def extend_scene(
    target: tuple[str, Sequence[Path], Path],
    sources: SourceOptions,
    options: ExtendOptions,
    connection: Connection,
    settings: Settings,
    report: Path | None,
    is_dry: bool,
) -> str:
    """Places the photographs of a target: scene, photographs, folder of results; prints what is placed and stored.

    Returns why the command failed, empty if it did not. ValueError for what is wrong before anything was computed.
    """
    scene, photos, out = target
    with terminable(), connected(connection, settings) as client, progress_bars() as progress:
        references = list(client.list_references(scene, page_size=1000))
        check_scene(scene, surveyed_of(references))
        if not is_dry:  # a call that needs the same role as storing, and changes nothing
            next(iter(client.audit_scene(scene, [references[0].reference_id])))
        work = prepare(photos, out)
        with locked(work, out), full_disk_named(out):
            pictures = read_sources(photos, work / "pictures", sources, progress)
            extension, known = extend(client, scene, pictures, work, options, progress)
            stored = None
            if extension.placement.placed and not is_dry:
                stored = store(client, extension, known, "mapless-server extend", progress)
    print("\n".join(lines(extension)))
    if report is not None:
        write_json(report, to_json(extension, stored))
    if stored is not None:
        print(f"stored: {len(stored.added)} references")
        if stored.stopped or stored.refused:
            refused = "; ".join(f"{it.frame}: {it.reason}" for it in stored.refused)
            return stored.stopped or f"refused by the server: {refused}"
    return "" if went_well(extension) else f"no photograph fits scene {scene}"
