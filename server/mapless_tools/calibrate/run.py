"""A calibration from beginning to end: reads, localizes, computes, stores, and reports."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from mapless import Client
from mapless.names import check_id
from mapless.scenes import Calibration
from mapless_server.serve.assembly import image_limits
from mapless_server.serve.signals import terminable
from mapless_server.settings import Settings, load_settings
from mapless_tools.child import temporary_server
from mapless_tools.connection import Connection, connected
from mapless_tools.dataset import Dataset
from mapless_tools.evaluate.plan import EvaluationOptions, evenly_spread
from mapless_tools.evaluate.references import check_images
from mapless_tools.evaluate.run import plan_for, store_references
from mapless_tools.ingest.formats import read_dataset
from mapless_tools.output_files import write_json
from mapless_tools.progress import Progress, progress_bars, tracked
from mapless_tools.usage import UsageError, usage_errors

from .findings import Findings, RightRule, find
from .queries import Outcome, Query, localize, other_world, planned_queries, scene_queries
from .report import CalibrationReport, page, print_report, to_json

OWN_SCENE = "calibration"


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of a calibration, of a scene, or of a folder by itself."""

    scene: str = ""
    layout: str = "auto"
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)
    right: RightRule = field(default_factory=RightRule)
    dry_run: bool = False

    def __post_init__(self) -> None:
        if self.scene:
            check_id(self.scene)
            if self.evaluation.reference_count is not None:
                raise ValueError("--references: only without --scene, which has its own")
        elif self.dry_run:
            raise ValueError("--dry-run: only with --scene, nothing is stored without one")


def clear_calibration(folder: Path | None, scene: str, connection: Connection) -> None:
    """Removes a scene's calibration; UsageError if no scene is named, or a folder is."""
    with usage_errors():
        if folder is not None or not scene:
            raise ValueError("--clear takes --scene and no folder")
        check_id(scene)
        settings = load_settings({}).settings
    with terminable(), _connected(connection, settings) as client:
        client.update_scene(scene, calibration=None)


def calibrate(folder: Path, options: CalibrateOptions, connection: Connection, output: Path) -> bool:
    """Measures, prints, writes the report, and stores the factors if there is a scene; returns whether there are any.

    UsageError for a wrong folder, file or setting, or if the folder's poses are not in the scene's world.
    """
    with usage_errors():
        settings = load_settings({}).settings
        dataset = read_dataset(folder, options.layout)
    output.mkdir(parents=True, exist_ok=True)
    measure = _measure_scene if options.scene else _measure_folder
    with terminable(), progress_bars() as progress:
        report = measure(dataset, options, connection, settings, progress)
    print_report(report, Console())
    write_json(output / "report.json", to_json(report))
    (output / "report.html").write_text(page(report), encoding="utf-8")
    print(f"{output / 'report.html'}, {output / 'report.json'}")
    return report.found.factors is not None


def _measure_folder(
    dataset: Dataset, options: CalibrateOptions, _: Connection, settings: Settings, progress: Progress
) -> CalibrationReport:
    """Measures the folder alone, split as by `evaluate`, on a server of its own."""
    plan = plan_for(dataset, options.evaluation, settings, progress)
    with temporary_server() as client:
        store_references(client, OWN_SCENE, plan.references, progress)
        outcomes = _localize_all(client, OWN_SCENE, planned_queries(plan.queries), options.evaluation, progress)
    stored = "not stored: no --scene was given"
    return CalibrationReport(
        dataset, "", len(plan.references), options.evaluation.k, options.right, stored, find(outcomes, options.right)
    )


def _measure_scene(
    dataset: Dataset, options: CalibrateOptions, connection: Connection, settings: Settings, progress: Progress
) -> CalibrationReport:
    """Measures a stored scene; its calibration is replaced by the found factors, except in a dry run."""
    frames = evenly_spread(dataset.frames, options.evaluation.query_count)
    check_images(frames, image_limits(settings))
    with _connected(connection, settings) as client:
        scene = client.get_scene(options.scene)
        queries = scene_queries(client, options.scene, frames, progress)
        outcomes = _localize_all(client, options.scene, queries, options.evaluation, progress)
        other = other_world(outcomes)
        if other is not None:
            raise UsageError(str(other))
        found = find(outcomes, options.right)
        stored = _store(client, options, found, scene.calibration)
    return CalibrationReport(
        dataset, options.scene, scene.reference_count, options.evaluation.k, options.right, stored, found
    )


def _store(client: Client, options: CalibrateOptions, found: Findings, before: Calibration | None) -> str:
    """Stores the factors and says what was done; `before` is the calibration that the scene had."""
    if found.factors is None or found.conditions is None:
        return f"not stored: {found.refusal}"
    if options.dry_run:
        return "not stored: a dry run"
    if client.get_scene(options.scene).calibration != before:
        return "not stored: the scene was calibrated by another command meanwhile"
    client.update_scene(options.scene, calibration=calibration_of(found))
    return f"stored with scene {options.scene}, from {len(found.sample)} answers"


def calibration_of(found: Findings) -> Calibration:
    """Makes the calibration to store from findings that have factors."""
    assert found.factors is not None
    assert found.conditions is not None
    return Calibration(
        position_factor_68=found.factors.position_68,
        position_factor_95=found.factors.position_95,
        rotation_factor_68=found.factors.rotation_68,
        rotation_factor_95=found.factors.rotation_95,
        query_count=len(found.sample),
        features=found.conditions.features,
        backend=found.conditions.backend,
        variant=found.conditions.variant,
        server_version=found.conditions.server_version,
    )


def _localize_all(
    client: Client, scene: str, queries: Sequence[Query], options: EvaluationOptions, progress: Progress
) -> list[Outcome]:
    localizing = tracked("localizing", queries, len(queries), progress)
    return [localize(client, scene, query, count=options.k, variant=options.variant) for query in localizing]


@contextmanager
def _connected(connection: Connection, settings: Settings) -> Iterator[Client]:
    """Connects as `connected`; errors in the connection's options become UsageError."""
    with ExitStack() as stack:
        with usage_errors():
            client = stack.enter_context(connected(connection, settings))
        yield client
