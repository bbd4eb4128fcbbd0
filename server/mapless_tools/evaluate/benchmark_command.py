"""`mapless-server evaluate` on benchmarks: everything is checked first, then measured, then reported."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mapless_server.serve.assembly import image_limits
from mapless_server.serve.signals import terminable
from mapless_server.settings import Settings, load_settings
from mapless_tools.dataset import Dataset
from mapless_tools.ingest.formats import ReadOptions, read_dataset
from mapless_tools.progress import Progress, progress_bars

from .averages import groups_of
from .benchmarks import ScenePlace, find_scenes
from .command import usage_errors
from .figures import write_figures
from .page import facts, page, problems
from .pairs import chosen, pairs_file, read_pairs
from .pictures import WorstQuery, worst_of
from .plan import UsageError, check_images
from .protocol import SuiteOptions, split_scene
from .provenance import provenance_of
from .run import first_features
from .suite import Apparatus, Run, SceneWork, Suite, measure
from .tables import tables_of, text_lines

PAGE_FILE = "report.html"
RUNS_FOLDER = "runs"
NO_POSE = ("pose:", "ground truth:")
"""How the reason begins for which readers refuse a frame that the benchmark has no pose of."""


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
    """Measures the server on a scene, or on all scenes of a folder, and writes the report.

    Args:
        folder: a scene, or what holds scenes.
        output: folder of the report; made if need be. What it holds of the same evaluation is not measured again.
        pairs: references of each query, a file or a folder with one for each scene; None: see the options' `choice`.
        ground_truth: poses instead of the layout's own, see `ReadOptions`.
        partial: whether images that are missing or damaged may be left out; the report names them.
        worst: how many queries of each scene are shown as pictures.
        options: those of SuiteOptions.

    Returns:
        Whether everything was measured.

    Raises:
        UsageError: a wrong folder, option, file or setting; nothing was measured.
    """
    with usage_errors():
        checked = SuiteOptions(**options)
        if worst < 0:
            raise UsageError(f"worst must be 0 or more, not {worst}")
        settings = load_settings({}).settings
        extractor, ratio = first_features(settings)
        provenance = provenance_of(settings)
        places = find_scenes(folder, checked.layout)
        journals = _output_folder(output)
    with terminable(), progress_bars() as progress:
        scenes = _scenes(places, checked, settings, pairs, ground_truth, partial, progress)
        apparatus = Apparatus(checked, settings, provenance, journals, progress)
        suite = measure(scenes, apparatus, pairs, lambda so_far: write_figures(so_far, output))
        shown: list[WorstQuery] = []
        runs = _shown_runs(suite) if worst else []
        for done, run in enumerate(runs):
            progress("pictures", done, len(runs))
            shown += worst_of(run, worst, extractor, ratio, image_limits(settings))
    (output / PAGE_FILE).write_text(page(suite, shown), encoding="utf-8")
    _print(suite)
    print(f"{output / PAGE_FILE}, with evaluation.json, evaluation.csv and queries.csv beside it")
    return not suite.failures


def _output_folder(output: Path) -> Path:
    """The folder of the journals in it; raises UsageError if it cannot be written."""
    journals = output / RUNS_FOLDER
    try:
        journals.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=journals):
            pass
    except OSError as error:
        raise UsageError(f"{output} cannot be written: {error.strerror}") from error
    return journals


def _scenes(
    places: Sequence[ScenePlace],
    options: SuiteOptions,
    settings: Settings,
    pairs: Path | None,
    ground_truth: Path | None,
    partial: bool,
    progress: Progress,
) -> list[SceneWork]:
    """All scenes read, split and checked: hours later is too late to hear of a missing file."""
    scenes = []
    for done, place in enumerate(places):
        progress("reading scenes", done, len(places))
        with usage_errors():
            dataset = read_dataset(place.path, place.layout, ReadOptions(ground_truth=ground_truth))
        if not dataset.metric:
            raise UsageError(f"{place.name}: its unit of length is arbitrary, the paper's figures are centimetres")
        _check_images(place, dataset, settings, partial)
        splits = tuple(split_scene(dataset, setting, options) for setting in options.settings(place))
        its = None
        if pairs is not None:
            its = read_pairs(pairs_file(pairs, place.name, len(places)), dataset, place.path)
            for split in splits:
                known = {frame.name for frame in split.references}
                for query in split.queries:
                    chosen(its, query, known, options.k)
        scenes.append(SceneWork(place, dataset, splits, its))
    return scenes


def _check_images(place: ScenePlace, dataset: Dataset, settings: Settings, partial: bool) -> None:
    """Raises UsageError if images cannot be used; that a benchmark has no pose of some is its own matter."""
    faults = [refusal for refusal in dataset.refused if not refusal.reason.startswith(NO_POSE)]
    if faults and not partial:
        raise UsageError(
            f"{place.name}: {len(faults)} of {len(dataset.frames) + len(dataset.refused)} frames cannot be used, the "
            f"first, {faults[0].frame}: {faults[0].reason}; --partial leaves them out"
        )
    first = {frame.split: frame for frame in reversed(dataset.frames)}
    check_images(first.values(), image_limits(settings))


def _shown_runs(suite: Suite) -> list[Run]:
    """Of each scene the first method in the densest and in the sparsest setting."""
    method = suite.options.methods()[0]
    shown = []
    for scene in suite.scenes:
        runs = [run for run in suite.runs if run.scene is scene and run.method == method]
        shown += [*runs[:1], *runs[1:][-1:]]
    return shown


def _print(suite: Suite) -> None:
    for group in groups_of(suite):
        for table in (table for table in tables_of(group) if not table.wide):
            print(f"\n{group.title}. {table.title}")
            print("\n".join((*text_lines(table), *table.notes)))
    print()
    for name, value in facts(suite).items():
        print(f"{name}: {value}")
    print("\n".join(problems(suite)))
