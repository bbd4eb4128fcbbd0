"""Runs by benchmark, and their figures averaged over scenes: the mean of the scenes' medians, as in the paper."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from .benchmarks import BENCHMARKS, Benchmark
from .metrics import RECALL_BARS, QueryResult, Summary, summarize
from .plan import Method
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
        groups.append(
            Group(
                layout,
                BENCHMARKS.get(layout),
                tuple(scene.place.name for scene in scenes),
                tuple(settings),
                suite.options.methods(),
                runs,
            )
        )
    return tuple(groups)


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values) if all(map(math.isfinite, values)) else math.inf
