"""An evaluation as in the paper, from end to end: every scene, setting and method, each query through a real server.

A scene has a server of its own, which holds a set of references for each setting. What is measured is written at once
(`journal`), so that an evaluation of days can be interrupted, and a scene that fails does not take the others with it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

from mapless import Client, MaplessError
from mapless_server.serve.assembly import image_limits
from mapless_server.settings import Settings
from mapless_tools.child import ServerFailed, child_server
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.progress import Progress

from .benchmarks import ScenePlace
from .journal import Identity, Journal
from .metrics import QueryResult
from .pairs import Pairs, chosen
from .plan import EvaluationOptions, PlannedQuery, UsageError, rank_by_matches
from .protocol import Method, SceneSplit, SuiteOptions, setting_name
from .provenance import Provenance
from .run import CONNECT, first_features, localize_query, store_references


@dataclass(frozen=True, eq=False)
class SceneWork:
    """A scene that is ready to be measured.

    Attributes:
        splits: one for each setting.
        pairs: the references of its queries; None unless they were given.
    """

    place: ScenePlace
    dataset: Dataset
    splits: tuple[SceneSplit, ...]
    pairs: Pairs | None


@dataclass(frozen=True, eq=False)
class Run:
    """The results of one method in one setting of one scene, in the order of its queries.

    Attributes:
        journal: the file that they are in.
    """

    scene: SceneWork
    split: SceneSplit
    method: Method
    results: tuple[QueryResult, ...]
    journal: Path


@dataclass(frozen=True)
class Failure:
    """A scene, or a part of one, that could not be measured."""

    scene: str
    message: str


@dataclass(frozen=True, eq=False)
class Suite:
    """Everything that was measured, and what it is of.

    Attributes:
        runs: complete ones, in the order of scenes, settings and methods.
        failures: what is missing, and why.
        pairs: file or folder of given pairs; None without.
    """

    options: SuiteOptions
    provenance: Provenance
    scenes: tuple[SceneWork, ...]
    runs: tuple[Run, ...]
    failures: tuple[Failure, ...]
    pairs: Path | None = None


@dataclass(frozen=True)
class Apparatus:
    """What scenes are measured with.

    Attributes:
        journals: folder of the journals; exists.
    """

    options: SuiteOptions
    settings: Settings
    provenance: Provenance
    journals: Path
    progress: Progress


def measure(
    scenes: Sequence[SceneWork], apparatus: Apparatus, pairs: Path | None, on_scene: Callable[[Suite], None]
) -> Suite:
    """Measures all scenes; what a journal has already is not measured again.

    Args:
        scenes: what to measure.
        apparatus: with what.
        pairs: for the report.
        on_scene: told of everything so far after each scene.
    """
    runs: list[Run] = []
    failures: list[Failure] = []
    suite = Suite(apparatus.options, apparatus.provenance, tuple(scenes), (), (), pairs)
    for scene in scenes:
        waiting = _waiting_runs(scene, apparatus)
        try:
            _measure_scene(scene, waiting, apparatus)
        except (MaplessError, ServerFailed, UsageError, OSError) as error:
            failures.append(Failure(scene.place.name, str(error)))
        for run in waiting:
            if run.complete:
                runs.append(run.finished())
            elif not failures or failures[-1].scene != scene.place.name:
                failures.append(Failure(scene.place.name, f"{run.label} is incomplete"))
        suite = Suite(apparatus.options, apparatus.provenance, tuple(scenes), tuple(runs), tuple(failures), pairs)
        on_scene(suite)
    return suite


@dataclass(frozen=True, eq=False)
class _WaitingRun:
    """A run and how far it is."""

    scene: SceneWork
    split: SceneSplit
    method: Method
    journal: Journal

    @property
    def label(self) -> str:
        return f"{setting_name(self.split.setting)}, {self.method.label}"

    @property
    def complete(self) -> bool:
        return all(query.name in self.journal.results for query in self.split.queries)

    def finished(self) -> Run:
        results = tuple(self.journal.results[query.name] for query in self.split.queries)
        return Run(self.scene, self.split, self.method, results, self.journal.path)


def _waiting_runs(scene: SceneWork, apparatus: Apparatus) -> list[_WaitingRun]:
    runs = []
    queries = _digest(_told(frame) for frame in scene.dataset.frames if frame.split != "train")
    for split in scene.splits:
        references = _digest(map(_told, split.references))
        for method in apparatus.options.methods():
            name = ".".join((scene.place.name.replace("/", "_"), setting_name(split.setting), *asdict(method).values()))
            data = {"scene": scene.place.name, "references": references, "queries": queries, **asdict(method)}
            journal = Journal(apparatus.journals, name, {**data, **_identity(scene, apparatus)})
            runs.append(_WaitingRun(scene, split, method, journal))
    return runs


def _identity(scene: SceneWork, apparatus: Apparatus) -> Identity:
    """What a scene's results depend on beside the data; how many queries is no part: more go on where fewer ended."""
    made, options = apparatus.provenance, apparatus.options
    pairs = None
    if scene.pairs is not None:
        pairs = _digest(f"{query} {frame.name}" for query, its in sorted(scene.pairs.items()) for frame in its)
    return {
        "ground_truth": scene.dataset.ground_truth,
        "k": options.k,
        "choice": "pairs" if pairs else options.choice,
        "pairs": pairs,
        "version": made.version,
        "commit": made.commit,
        "weights": made.weights,
        "settings": made.settings,
    }


def _told(frame: Frame) -> str:
    return f"{frame.name} {frame.camera} {frame.world_from_camera.matrix().round(9).tolist()}"


def _digest(lines: Iterable[str]) -> str:
    return sha256("\n".join(lines).encode()).hexdigest()[:16]


def _measure_scene(scene: SceneWork, runs: Sequence[_WaitingRun], apparatus: Apparatus) -> None:
    waiting = [run for run in runs if not run.complete]
    if not waiting:
        return
    with (
        tempfile.TemporaryDirectory(prefix="mapless-evaluate-") as data_dir,
        child_server(Path(data_dir)) as server,
        Client(server.address, CONNECT) as client,
    ):
        for split in scene.splits:
            its = [run for run in waiting if run.split is split]
            if its:
                _measure_setting(client, split, its, apparatus)


def _measure_setting(client: Client, split: SceneSplit, runs: Sequence[_WaitingRun], apparatus: Apparatus) -> None:
    scene, scene_id = runs[0].scene, setting_name(split.setting).replace("=", "-")

    def labelled(label: str) -> Progress:
        return lambda step, done, total: apparatus.progress(f"{scene.place.name}, {label}: {step}", done, total)

    planned = _with_references(scene, split, apparatus, labelled(setting_name(split.setting)))
    store_references(client, scene_id, split.references, labelled(setting_name(split.setting)))
    references = {frame.name: frame for frame in split.references}
    for run in runs:
        options = EvaluationOptions(k=apparatus.options.k, variant=run.method.variant, scale_strategy=run.method.scale)
        progress = labelled(run.label)
        progress("localizing", len(run.journal.results), len(planned))
        for done, query in enumerate(planned, start=1):
            if query.frame.name not in run.journal.results:
                run.journal.add(localize_query(client, scene_id, query, options, references))
                progress("localizing", done, len(planned))


def _with_references(
    scene: SceneWork, split: SceneSplit, apparatus: Apparatus, progress: Progress
) -> tuple[PlannedQuery, ...]:
    """The queries with their references; without where the server is to choose."""
    options = apparatus.options
    if scene.pairs is not None:
        pairs = scene.pairs
        known = {frame.name for frame in split.references}
        return tuple(PlannedQuery(query, chosen(pairs, query, known, options.k)) for query in split.queries)
    if options.choice == "matches":
        extractor, ratio = first_features(apparatus.settings)
        limits = image_limits(apparatus.settings)
        return rank_by_matches(split.queries, split.references, options.k, extractor, ratio, limits, progress)
    given = split.references if options.choice == "given" else ()
    return tuple(PlannedQuery(query, given) for query in split.queries)
