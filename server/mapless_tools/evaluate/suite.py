"""An evaluation as in the paper: every scene, setting and method, each query through a real server.

A scene has a server of its own, which holds a set of references for each setting. Each result is written to a journal
at once, so that an evaluation of days can be interrupted, and a scene that fails does not stop the others.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from mapless import Accuracy, Attempt, Client, IntrinsicsCheck, MaplessError
from mapless_server import __version__
from mapless_server.networks.weights import CATALOGUE
from mapless_server.networks.weights.folder import Status, look_up, recorded
from mapless_server.observability.provenance import ROOT, commit_of, cpu_model
from mapless_server.serve.features import device_for, feature_names
from mapless_server.settings import Settings, available_cores
from mapless_tools.child import ServerFailed, temporary_server
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.progress import Progress, labelled
from mapless_tools.usage import UsageError

from .benchmarks import ScenePlace
from .metrics import EarlierAnswer, QueryResult
from .plan import EvaluationOptions, Method, SceneSplit, SuiteOptions, setting_name
from .references import Matcher, Pairs, PlannedQuery, paired, rank_by_matches
from .run import await_features, localize_query, store_references


@dataclass(frozen=True)
class Provenance:
    """The origin of figures.

    The commit is `git describe` of a checkout, with a digest of what is not committed; empty for an installed package.
    Weights are the SHA-256 of each network's file that the settings use; "not recorded" for a file copied by hand. The
    machine includes the GPU if networks use one; the date is when it began, UTC.
    """

    version: str
    commit: str
    weights: dict[str, str]
    settings: dict[str, str]
    machine: str
    date: str


def provenance_of(settings: Settings) -> Provenance:
    """The origin of figures of a server with these settings; errors as in `device_for` and `feature_names`."""
    device = device_for(settings)
    features = feature_names(settings, device)
    used = {settings.backend, *features, *(f"{name}-lightglue" for name in features if device != "cpu")}
    if settings.retrieval == "megaloc" or (settings.retrieval == "auto" and device != "cpu"):
        used.add("megaloc")
    weights = {}
    for entry in CATALOGUE:
        stored = look_up(entry, settings.weights_dir)
        if entry.name in used and stored.status not in (Status.ABSENT, Status.NO_FILE):
            known = stored.status is not Status.UNCHECKED and recorded(stored.path)
            weights[entry.name] = known or "not recorded"
    figures_of = {
        "backend": settings.backend,
        "features": ", ".join(features),
        "device": device,
        "retrieval": settings.retrieval,
    }
    date = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return Provenance(__version__, commit_of(ROOT), weights, figures_of, _machine(device), date)


def _machine(device: str) -> str:
    machine = f"{cpu_model()}, {available_cores()} cores"
    if device == "cpu":
        return machine
    import torch

    return f"{machine}; {torch.cuda.get_device_name(torch.device(device))}"


@dataclass(frozen=True, eq=False)
class SceneWork:
    """A scene that is ready for measurement, with a split for each setting, and pairs if they were given."""

    place: ScenePlace
    dataset: Dataset
    splits: tuple[SceneSplit, ...]
    pairs: Pairs | None


@dataclass(frozen=True, eq=False)
class Run:
    """One method in one setting of one scene, and its results so far."""

    scene: SceneWork
    split: SceneSplit
    method: Method
    journal: "Journal"

    @property
    def label(self) -> str:
        """The setting and the method."""
        return f"{setting_name(self.split.setting)}, {self.method.label}"

    @property
    def complete(self) -> bool:
        """Whether all queries have results."""
        return all(query.name in self.journal.results for query in self.split.queries)

    @property
    def results(self) -> tuple[QueryResult, ...]:
        """The results of a complete run, in the order of its queries."""
        return tuple(self.journal.results[query.name] for query in self.split.queries)


@dataclass(frozen=True)
class Failure:
    """A scene, or a part of one, that could not be measured."""

    scene: str
    message: str


@dataclass(frozen=True, eq=False)
class Suite:
    """Everything that was measured, and its circumstances.

    Runs are complete, in the order of scenes, settings and methods; failures say what is missing, and why. `pairs` is
    the file or folder of given pairs.
    """

    options: SuiteOptions
    provenance: Provenance
    scenes: tuple[SceneWork, ...]
    runs: tuple[Run, ...]
    failures: tuple[Failure, ...]
    pairs: Path | None = None


@dataclass(frozen=True)
class RunSetup:
    """The common parts of all runs."""

    options: SuiteOptions
    matcher: Matcher
    provenance: Provenance
    journals: Path
    progress: Progress


def measure(
    scenes: Sequence[SceneWork], setup: RunSetup, pairs: Path | None, on_scene: Callable[[Suite], None]
) -> Suite:
    """Measures all scenes; results that a journal already has are not measured again.

    `pairs` is for the report; `on_scene` is called with everything so far after each scene.
    """
    runs: list[Run] = []
    failures: list[Failure] = []
    suite = Suite(setup.options, setup.provenance, tuple(scenes), (), (), pairs)
    for scene in scenes:
        runs_of_scene = _runs_of(scene, setup)
        try:
            _measure_scene(scene, runs_of_scene, setup)
        except (MaplessError, ServerFailed, UsageError, OSError) as error:
            failures.append(Failure(scene.place.name, str(error)))
        for run in runs_of_scene:
            if run.complete:
                runs.append(run)
            elif not failures or failures[-1].scene != scene.place.name:
                failures.append(Failure(scene.place.name, f"{run.label} is incomplete"))
        suite = Suite(setup.options, setup.provenance, tuple(scenes), tuple(runs), tuple(failures), pairs)
        on_scene(suite)
    return suite


class Journal:
    """The results of one run while they are computed: a file with a line for each query.

    The first line identifies the run; the file's name ends in a digest of it. A run that is started again with the same
    data, options, code and weights continues at the end of its file; any other run has another file.
    """

    def __init__(self, folder: Path, name: str, identity: Mapping[str, Any]) -> None:
        """Reads the existing file, if any, of the run whose results depend on `identity`, JSON values."""
        self._head = json.dumps(identity, sort_keys=True)
        self.path = folder / f"{name}.{hashlib.sha256(self._head.encode()).hexdigest()[:12]}.jsonl"
        self.results: dict[str, QueryResult] = {}
        if self.path.is_file():
            self._read()

    def _read(self) -> None:
        """Reads complete lines; an incomplete line, and what follows it, is cut off."""
        content = self.path.read_bytes()
        head, *lines = content.split(b"\n")
        if head.decode() != self._head:
            os.truncate(self.path, 0)
            return
        whole = len(head) + 1
        for line in lines[:-1]:
            try:
                result = _result(json.loads(line))
            except (ValueError, TypeError, KeyError):
                break
            self.results[result.name] = result
            whole += len(line) + 1
        if whole < len(content):
            os.truncate(self.path, whole)

    def add(self, result: QueryResult) -> None:
        """Writes a result; once this returns, it survives the end of the program."""
        begins = not self.path.is_file() or not self.path.stat().st_size
        # Only rejections have infinities: they are written as null.
        line = {
            name: None if isinstance(value, float) and math.isinf(value) else value
            for name, value in asdict(result).items()
        }
        with self.path.open("a", encoding="utf-8") as stream:
            if begins:
                stream.write(self._head + "\n")
            stream.write(json.dumps(line, allow_nan=False) + "\n")
        self.results[result.name] = result


def _result(line: dict[str, Any]) -> QueryResult:
    if set(line) != {field.name for field in fields(QueryResult)}:
        raise KeyError("another version's line")
    infinite = ("translation_error", "rotation_error_deg", "reference_distance")
    line |= {name: math.inf for name in infinite if line[name] is None}
    line["references"] = tuple(line["references"])
    line["pose"] = None if line["pose"] is None else tuple(line["pose"])
    line["accuracy"] = None if line["accuracy"] is None else Accuracy(**line["accuracy"])
    line["intrinsics_checks"] = tuple(IntrinsicsCheck(**check) for check in line["intrinsics_checks"])
    line["attempts"] = tuple(Attempt(**attempt) for attempt in line["attempts"])
    line["earlier"] = tuple(EarlierAnswer(**answer) for answer in line["earlier"])
    return QueryResult(**line)


def _runs_of(scene: SceneWork, setup: RunSetup) -> list[Run]:
    runs = []
    queries = _digest(map(_description, (frame for frame in scene.dataset.frames if frame.split != "train")))
    for split in scene.splits:
        references = _digest(map(_description, split.references))
        for method in setup.options.methods():
            name = ".".join((scene.place.name.replace("/", "_"), setting_name(split.setting), *asdict(method).values()))
            data = {"scene": scene.place.name, "references": references, "queries": queries, **asdict(method)}
            journal = Journal(setup.journals, name, {**data, **_identity(scene, setup)})
            runs.append(Run(scene, split, method, journal))
    return runs


def _identity(scene: SceneWork, setup: RunSetup) -> dict[str, Any]:
    """All that results depend on besides the data, without the number of queries, so that more can be added."""
    made, options = setup.provenance, setup.options
    pairs = None
    if scene.pairs is not None:
        pairs = _digest(f"{query} {frame.name}" for query, given in sorted(scene.pairs.items()) for frame in given)
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


def _description(frame: Frame) -> str:
    return f"{frame.name} {frame.camera} {frame.world_from_camera.matrix().round(9).tolist()}"


def _digest(lines: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _measure_scene(scene: SceneWork, runs: Sequence[Run], setup: RunSetup) -> None:
    incomplete = [run for run in runs if not run.complete]
    if incomplete:
        with temporary_server() as client:
            for split in scene.splits:
                of_split = [run for run in incomplete if run.split is split]
                if of_split:
                    _measure_setting(client, split, of_split, setup)


def _measure_setting(client: Client, split: SceneSplit, runs: Sequence[Run], setup: RunSetup) -> None:
    scene, scene_id = runs[0].scene, setting_name(split.setting).replace("=", "-")
    progress = labelled(setup.progress, f"{scene.place.name}, {setting_name(split.setting)}")
    planned = _with_references(scene, split, setup, progress)
    store_references(client, scene_id, split.references, progress)
    await_features(client, scene_id, progress)
    references = {frame.name: frame.world_from_camera for frame in split.references}
    for run in runs:
        options = EvaluationOptions(k=setup.options.k, variant=run.method.variant, scale_strategy=run.method.scale)
        progress = labelled(setup.progress, f"{scene.place.name}, {run.label}")
        progress("localizing", len(run.journal.results), len(planned))
        for done, query in enumerate(planned, start=1):
            if query.frame.name not in run.journal.results:
                run.journal.add(localize_query(client, scene_id, query, options, references))
                progress("localizing", done, len(planned))


def _with_references(
    scene: SceneWork, split: SceneSplit, setup: RunSetup, progress: Progress
) -> tuple[PlannedQuery, ...]:
    options = setup.options
    if scene.pairs is not None:
        known = {frame.name for frame in split.references}
        return tuple(paired(scene.pairs, query, known, options.k) for query in split.queries)
    if options.choice == "matches":
        return rank_by_matches(split.queries, split.references, options.k, setup.matcher, progress)
    given = split.references if options.choice == "given" else ()
    return tuple(PlannedQuery(query, given) for query in split.queries)
