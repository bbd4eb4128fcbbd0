"""`mapless-server evaluate`: everything is checked first, then measured, then reported."""

import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.console import Console

from mapless.names import check_id
from mapless_server.serve.assembly import image_limits
from mapless_server.serve.signals import terminable
from mapless_server.settings import load_settings
from mapless_tools.connection import Connection, connected
from mapless_tools.ingest.depth_options import DepthOptions
from mapless_tools.ingest.formats import ReadOptions, read_dataset
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.output_files import check_writable, write_json
from mapless_tools.progress import progress_bars
from mapless_tools.usage import UsageError, usage_errors

from .benchmarks import ScenePlace, find_scenes
from .calibrate import fit_calibration, measure_scene, photographs
from .plan import EvaluationOptions, SuiteOptions, split_scene
from .references import Matcher, check_images, paired, pairs_file, read_pairs
from .report import print_report, to_json
from .run import evaluate
from .suite import RunSetup, SceneWork, measure, provenance_of

PAGE_FILE = "report.html"
RUNS_FOLDER = "runs"
NO_POSE = ("pose:", "ground truth:")
"""How the reason begins for which readers refuse a frame that the benchmark has no pose of."""


def evaluate_folder(folder: Path, json_file: Path | None, **options: Any) -> None:
    """Measures the server on a folder with cameras.json, prints the table, and writes the JSON file, if named.

    `options` are those of EvaluationOptions. UsageError for a wrong folder, option, file or setting.
    """
    with usage_errors():
        checked = EvaluationOptions(**options)
        dataset = read_folder(folder)
        settings = load_settings({}).settings
        if json_file is not None:
            check_writable(json_file)
    with terminable(), progress_bars() as progress:
        evaluation = evaluate(dataset, checked, settings, progress)
    print_report(evaluation, Console())
    if json_file is not None:
        write_json(json_file, to_json(evaluation))


def calibrate_scene(
    folder: Path, layout: str, scene_id: str, connection: Connection, json_file: Path | None, **options: Any
) -> None:
    """Measures a stored scene on a folder's photographs, prints the table, and stores the factors of its radii.

    `options` are those of EvaluationOptions. UsageError for a wrong folder, option, file, setting or scene, or if too
    few photographs are localized.
    """
    with usage_errors():
        checked = EvaluationOptions(**options)
        check_id(scene_id)
        settings = load_settings({}).settings
        dataset = read_dataset(folder, layout)
        frames = photographs(dataset, checked, image_limits(settings))
        if json_file is not None:
            check_writable(json_file)
    with terminable(), ExitStack() as stack:
        with usage_errors():
            client = stack.enter_context(connected(connection, settings))
        with progress_bars() as progress:
            evaluation, measured = measure_scene(client, scene_id, dataset, frames, checked, progress)
        print_report(evaluation, Console())
        if json_file is not None:
            write_json(json_file, to_json(evaluation))
        found = fit_calibration(measured)
        client.update_scene(scene_id, calibration=found.calibration)
    print(f"stored with scene {scene_id}, {found}")


def evaluate_benchmarks(
    folder: Path,
    output: Path,
    *,
    pairs: Path | None = None,
    ground_truth: Path | None = None,
    partial: bool = False,
    worst: int = 4,
    **options: Any,
) -> bool:
    """Measures a scene, or all scenes of a folder, and writes the report; returns whether it is complete.

    What the folder `output` holds of the same evaluation is not measured again. `pairs` are references of each query, a
    file or a folder with one for each scene; `partial` leaves out images that are missing or damaged; so many `worst`
    queries of each scene are shown as pictures. `options` are fields of SuiteOptions.
    """
    from .figures import write_figures
    from .page import page, print_suite
    from .pictures import worst_queries

    with usage_errors():
        checked = SuiteOptions(**options)
        if worst < 0:
            raise UsageError(f"worst must be 0 or more, not {worst}")
        settings = load_settings({}).settings
        matcher = Matcher.of(settings)
        provenance = provenance_of(settings)
        places = find_scenes(folder, checked.layout)
        journals = _journal_folder(output)
    with terminable(), progress_bars() as progress:
        scenes = []
        for done, place in enumerate(places):
            progress("reading scenes", done, len(places))
            files = None if pairs is None else pairs_file(pairs, place.name, len(places))
            scenes.append(_read_scene(place, checked, matcher, files, ground_truth, partial))
        setup = RunSetup(checked, matcher, provenance, journals, progress)
        suite = measure(scenes, setup, pairs, lambda so_far: write_figures(so_far, output))
        shown = worst_queries(suite, worst, matcher, progress)
    (output / PAGE_FILE).write_text(page(suite, shown), encoding="utf-8")
    print_suite(suite)
    print(f"{output / PAGE_FILE}, with evaluation.json, evaluation.csv and queries.csv beside it")
    return not suite.failures


def _journal_folder(output: Path) -> Path:
    journals = output / RUNS_FOLDER
    try:
        journals.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=journals):
            pass
    except OSError as error:
        raise UsageError(f"{output} cannot be written: {error.strerror}") from error
    return journals


def _read_scene(
    place: ScenePlace,
    options: SuiteOptions,
    matcher: Matcher,
    pairs: Path | None,
    ground_truth: Path | None,
    partial: bool,
) -> SceneWork:
    """Reads, splits and checks a scene; UsageError if that is not possible, or images cannot be used."""
    with usage_errors():
        depths = DepthOptions(no_depth=place.benchmark is not None)  # the paper's figures are without
        dataset = read_dataset(place.path, place.layout, ReadOptions(ground_truth=ground_truth, depths=depths))
    if not dataset.metric:
        raise UsageError(f"{place.name}: its unit of length is arbitrary, the paper's figures are centimetres")
    faults = [refusal for refusal in dataset.refused if not refusal.reason.startswith(NO_POSE)]
    if faults and not partial:
        raise UsageError(
            f"{place.name}: {len(faults)} of {len(dataset.frames) + len(dataset.refused)} frames cannot be used, the "
            f"first, {faults[0].frame}: {faults[0].reason}; --partial leaves them out"
        )
    first = {frame.split: frame for frame in reversed(dataset.frames)}
    check_images(first.values(), matcher.limits)
    splits = tuple(split_scene(dataset, setting, options) for setting in options.settings(place))
    if pairs is None:
        return SceneWork(place, dataset, splits, None)
    known = read_pairs(pairs, dataset, place.path)
    for split in splits:
        names = {frame.name for frame in split.references}
        for query in split.queries:
            paired(known, query, names, options.k)
    return SceneWork(place, dataset, splits, known)
