"""The paper's tables with our figures beside its own: means of the scenes' medians, as in the paper."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from .benchmarks import BENCHMARKS, DENSE, Benchmark, Median, PaperMethod
from .metrics import RECALL_BARS, QueryResult, Summary, summarize
from .plan import Method, setting_name
from .report import RUNG_HEAD, RUNG_NOTES, format_stages, rung_cells
from .rungs import RIGHT_M, rungs_of
from .suite import Run, Suite

Key = tuple[str, int, Method]
"""Scene, setting and method."""


@dataclass(frozen=True)
class Average:
    """Figures of one method in one setting over scenes: means of the scenes' medians and shares.

    Infinite if one is. `complete` says whether these are all scenes that the paper averages over; True without figures
    of the paper.
    """

    scenes: tuple[str, ...]
    complete: bool
    median_translation: float
    median_rotation_deg: float
    recall: dict[str, float]
    localized_count: int
    query_count: int


@dataclass(frozen=True, eq=False)
class Group:
    """Runs on scenes of one layout, without those that could not be measured, and their summaries.

    The benchmark is None for folders with cameras.json.
    """

    layout: str
    benchmark: Benchmark | None
    scenes: tuple[str, ...]
    settings: tuple[int, ...]
    methods: tuple[Method, ...]
    runs: dict[Key, Run]
    summaries: dict[Key, Summary] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "summaries", {key: summarize(run.results) for key, run in self.runs.items()})

    @property
    def title(self) -> str:
        """Name of the benchmark, or else a description."""
        return self.benchmark.title if self.benchmark else "Own photographs"

    def results(self, scene: str, setting: int, method: Method) -> tuple[QueryResult, ...]:
        """Results of one run; empty if it could not be measured."""
        run = self.runs.get((scene, setting, method))
        return () if run is None else run.results

    def average(self, setting: int, method: Method) -> Average | None:
        """Average over the measured scenes that the paper averages over, else over all; None without any."""
        measured = tuple(scene for scene in self.scenes if (scene, setting, method) in self.summaries)
        papers = tuple(self.benchmark.scenes) if self.benchmark else ()
        scenes = tuple(scene for scene in measured if scene in papers) or measured
        if not scenes:
            return None
        summaries = [self.summaries[scene, setting, method] for scene in scenes]
        return Average(
            scenes=scenes,
            complete=set(scenes) == set(papers or self.scenes),
            median_translation=_mean([s.median_translation for s in summaries]),
            median_rotation_deg=_mean([s.median_rotation_deg for s in summaries]),
            recall={name: _mean([s.recall[name] for s in summaries]) for name in RECALL_BARS},
            localized_count=sum(s.localized_count for s in summaries),
            query_count=sum(s.query_count for s in summaries),
        )


def groups_of(suite: Suite) -> tuple[Group, ...]:
    """Groups the runs by benchmark."""
    groups = []
    for layout in dict.fromkeys(scene.place.layout for scene in suite.scenes):
        scenes = [scene for scene in suite.scenes if scene.place.layout == layout]
        settings = dict.fromkeys(split.setting for scene in scenes for split in scene.splits)
        runs = {
            (run.scene.place.name, run.split.setting, run.method): run
            for run in suite.runs
            if run.scene.place.layout == layout
        }
        names, methods = tuple(scene.place.name for scene in scenes), suite.options.methods()
        groups.append(Group(layout, BENCHMARKS.get(layout), names, tuple(settings), methods, runs))
    return tuple(groups)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if all(map(math.isfinite, values)) else math.inf


OURS, PAPERS, RIVAL = "ours", "paper", "rival"
NO_FIGURE = "\N{EN DASH}"
"""Not measured, or not in the paper."""
FAILED = "failed"
"""A median that is infinite: half of the queries, or more, were not localized."""

METRIC_ALREADY = (
    "The backend geometric triangulates from the references' own poses: its reconstruction is metric already, and the "
    "strategies agree. They differ with pi3 and pi3x."
)


@dataclass(frozen=True)
class Row:
    """A line of a table, and the origin of its figures: `OURS`, `PAPERS` or `RIVAL`."""

    cells: tuple[str, ...]
    source: str


@dataclass(frozen=True)
class Table:
    """A table for people; the first column names the lines. A `wide` one is too wide for a terminal."""

    title: str
    head: tuple[str, ...]
    rows: tuple[Row, ...]
    notes: tuple[str, ...] = ()
    wide: bool = False


def tables_of(group: Group) -> tuple[Table, ...]:
    """All tables of a benchmark that are not empty."""
    tables = [_dense(group)] if DENSE in group.settings else []
    tables += [_by_setting(group), _recall(group), _by_scene(group)]
    if len({method.scale for method in group.methods}) > 1:
        tables.append(_scales(group))
    return tuple(table for table in (*tables, _timing(group), _attempts(group)) if table.rows)


def format_median(translation_cm: float, rotation_deg: float) -> str:
    """A median in the paper's form with one more digit: "0.62/0.214"."""
    if math.isinf(translation_cm) or math.isinf(rotation_deg):
        return FAILED
    return (
        f"{translation_cm:.2f}/{rotation_deg:.3f}"
        if translation_cm < 100
        else f"{translation_cm:.0f}/{rotation_deg:.2f}"
    )


def _dense(group: Group) -> Table:
    names = group.benchmark.scenes if group.benchmark else {}
    scenes = tuple(dict.fromkeys((*names, *group.scenes)))
    rows = []
    for m in group.methods:
        medians = (_median(group.summaries.get((scene, DENSE, m))) for scene in scenes)
        rows.append(Row((_ours(m), *medians, _median(group.average(DENSE, m))), OURS))
    for method in _paper_methods(group):
        medians = (_papers(method.scenes.get(scene)) for scene in scenes)
        rows.append(_paper_row(method, *medians, _papers(method.average.get(DENSE))))
    head = ("method", *(names.get(scene, scene) for scene in scenes), "average")
    notes = [f'Of the paper: its table "{group.benchmark.dense_table}".'] if group.benchmark else []
    return Table("Dense: median error, cm/°", head, tuple(rows), (*notes, *_average_notes(group)))


def _by_setting(group: Group) -> Table:
    rows = [_average_row(group, _ours(m), m) for m in group.methods]
    for method in _paper_methods(group):
        if any(setting in method.average for setting in group.settings if setting != DENSE):
            cells = (_papers(method.average[s], FAILED) if s in method.average else NO_FIGURE for s in group.settings)
            rows.append(_paper_row(method, *cells))
    title = "By number of references: mean over scenes of the median error, cm/°"
    notes: list[str] = []
    if group.benchmark:
        notes = [f'Of the paper: its table "{group.benchmark.sparse_table}"; failed: in at least one scene.']
    head = ("method", *map(setting_name, group.settings))
    return Table(title, head, tuple(rows), (*notes, *_average_notes(group)))


def _recall(group: Group) -> Table:
    rows = []
    for setting in group.settings:
        for method in group.methods:
            average = group.average(setting, method)
            if average is not None:
                shares = (f"{100 * share:.1f}" for share in average.recall.values())
                localized = f"{average.localized_count} of {average.query_count}"
                rows.append(Row((f"{_ours(method)}, {setting_name(setting)}", *shares, localized), OURS))
    for paper in _paper_methods(group):
        if paper.recall_percent:
            shares = (f"{paper.recall_percent[bar]:g}" if bar in paper.recall_percent else NO_FIGURE for bar in _BARS)
            rows.append(_paper_row(paper, *shares, NO_FIGURE, setting=", dense"))
    head = ("method", *(bar.replace("_", ", ").replace("deg", "°").replace("cm", " cm") for bar in _BARS), "localized")
    return Table("Share of queries within, %", head, tuple(rows), _average_notes(group))


_BARS = ("1cm_1deg", "5cm_5deg", "25cm_2deg")


def _by_scene(group: Group) -> Table:
    rows = [
        Row((f"{scene}, {m.label}", *(_median(group.summaries.get((scene, s, m))) for s in group.settings)), OURS)
        for scene in group.scenes
        for m in group.methods
    ]
    head = ("scene", *map(setting_name, group.settings))
    return Table("Every scene: median error, cm/°", head, tuple(rows))


def _scales(group: Group) -> Table:
    """The table of the ablation: one variant with every strategy."""
    last = group.methods[-1].variant
    backends = {result.backend for run in group.runs.values() for result in run.results}
    methods = [method for method in group.methods if method.variant == last]
    rows = [_average_row(group, method.scale, method) for method in methods]
    return Table(
        f"Ablation of the scale, variant {last}: mean over scenes of the median error, cm/°",
        ("scale", *map(setting_name, group.settings)),
        tuple(rows),
        (*([METRIC_ALREADY] if backends == {"geometric"} else []), *_average_notes(group)),
    )


def _timing(group: Group) -> Table:
    rows = []
    for (scene, setting, method), summary in group.summaries.items():
        cells = (
            f"{scene}, {setting_name(setting)}, {method.label}",
            f"{summary.latency_p50_ms:.0f}",
            f"{summary.latency_p95_ms:.0f}",
            f"{summary.latency_first_ms:.0f}",
            format_stages(summary.stage_share),
            NO_FIGURE if summary.claim_held is None else f"{100 * summary.claim_held:.0f}",
            ", ".join(f"{count} {reason}" for reason, count in summary.rejections.items()) or "none",
        )
        rows.append(Row(cells, OURS))
    head = ("run", "p50 ms", "p95 ms", "first ms", "time by stage", "claimed 68 % radius held, %", "rejected")
    return Table("Time of a call, the server's own claims, and rejections", head, tuple(rows), wide=True)


def _attempts(group: Group) -> Table:
    rows = []
    for method in group.methods:
        results = [it for (_, _, own), run in group.runs.items() if own == method for it in run.results]
        for rung in rungs_of(results, RIGHT_M):
            name, *figures = rung_cells(rung)
            rows.append(Row((f"{name}, {method.label}" if len(group.methods) > 1 else name, *figures), OURS))
    return Table("Attempts, of all scenes and settings", RUNG_HEAD, tuple(rows), RUNG_NOTES)


def _average_notes(group: Group) -> tuple[str, ...]:
    averages = [group.average(setting, method) for setting in group.settings for method in group.methods]
    partial = {average.scenes for average in averages if average is not None and not average.complete}
    if group.benchmark is None or not partial:
        return ()
    scenes = max(partial, key=len)
    of_paper = sum(scene in group.benchmark.scenes for scene in scenes)
    return (
        f"Our averages are over {', '.join(scenes)}, {of_paper} of the paper's {len(group.benchmark.scenes)} scenes: "
        "not comparable with its averages.",
    )


def _ours(method: Method) -> str:
    return f"mapless {method.label}"


def _average_row(group: Group, name: str, method: Method) -> Row:
    return Row((name, *(_median(group.average(setting, method)) for setting in group.settings)), OURS)


def _paper_methods(group: Group) -> Sequence[PaperMethod]:
    """The paper's own methods first, then the others, the best first."""
    return group.benchmark.methods[::-1] if group.benchmark else ()


def _paper_row(method: PaperMethod, *cells: str, setting: str = "") -> Row:
    return Row((f"{method.name} (paper){setting}", *cells), PAPERS if method.variant else RIVAL)


def _median(summary: Summary | Average | None) -> str:
    if summary is None:
        return NO_FIGURE
    return format_median(100 * summary.median_translation, summary.median_rotation_deg)


def _papers(median: Median | None, absent: str = NO_FIGURE) -> str:
    return absent if median is None else f"{median[0]:g}/{median[1]:g}"
