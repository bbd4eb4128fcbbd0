"""What the paper's evaluation asks for: settings (how many references), runs (variant and scale), and who is in them.

A benchmark's references are the frames of its training split and its queries those of its test split. Dense, all of the
former are references; sparse, N of them, uniformly chosen. The paper's K = 10 references of each query are retrieved
from those, in the sparse settings too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapless_server.method.answer import Variant
from mapless_server.method.scale_equations import ScaleStrategy
from mapless_tools.dataset import Dataset, Frame

from .benchmarks import LAYOUTS, ScenePlace
from .paper import DENSE
from .plan import MAX_K, EvaluationOptions, UsageError, split_frames

PROTOCOLS = ("dense", "sparse")
CHOICES = ("retrieval", "matches", "given")
VARIANTS = tuple(variant.value for variant in Variant)
SCALES = tuple(strategy.value for strategy in ScaleStrategy)
MAX_MATCHED = 1000
"""Comparing a query with each reference's features takes 20 ms each: beyond this it is retrieval's job."""


@dataclass(frozen=True)
class SuiteOptions:
    """Options of an evaluation as in the paper.

    Attributes:
        layout: how the scenes lie on the disk; "auto" looks.
        protocols: dense, sparse or both.
        sparse: numbers of references; empty for the paper's of each benchmark.
        variants: forms of the method, each with the first of `scales`.
        scales: ways to find the metric scale; those after the first are run with `ablated` only.
        k: references that a query is given; the paper's.
        stride: dense, every so many-th training frame is a reference; 1, as in the paper, takes all.
        max_queries: queries of a scene, uniformly chosen; None, as in the paper, takes all.
        choice: who chooses a query's references: the server's own "retrieval" as for a caller who names none; feature
            "matches" counted here; or all are "given", first those taken first, without any ranking.
    """

    layout: str = "auto"
    protocols: tuple[str, ...] = PROTOCOLS
    sparse: tuple[int, ...] = ()
    variants: tuple[str, ...] = ("best",)
    scales: tuple[str, ...] = ("two_stage",)
    k: int = 10
    stride: int = 1
    max_queries: int | None = None
    choice: str = "retrieval"

    def __post_init__(self) -> None:
        for name, values, known in (
            ("layout", (self.layout,), LAYOUTS),
            ("protocol", self.protocols, PROTOCOLS),
            ("variant", self.variants, VARIANTS),
            ("scale", self.scales, SCALES),
            ("references", (self.choice,), CHOICES),
        ):
            unknown = [value for value in values if value not in known]
            if unknown or not values:
                raise ValueError(
                    f"{name} must be one of {', '.join(known)}, not {', '.join(map(repr, unknown)) or '-'}"
                )
            if len(set(values)) < len(values):
                raise ValueError(f"{name}: {', '.join(values)} names one twice")
        if any(count < 2 for count in self.sparse):
            raise ValueError(f"sparse: at least 2 references are needed for a baseline, not {min(self.sparse)}")
        if not 1 <= self.k <= MAX_K:
            raise ValueError(f"k, the references of a query, must be 1 to {MAX_K}, not {self.k}")
        if self.stride < 1:
            raise ValueError(f"stride must be at least 1, not {self.stride}")
        if self.max_queries is not None and self.max_queries < 1:
            raise ValueError(f"max-queries must be at least 1, not {self.max_queries}")

    @property
    def ablated(self) -> str:
        """The variant whose scale is varied: the paper's own where it is among the variants."""
        return "full" if "full" in self.variants else self.variants[0]

    def methods(self) -> tuple[Method, ...]:
        """What is run in every setting: each variant, then the ablation of the scale."""
        first, *others = self.scales
        return (*(Method(v, first) for v in self.variants), *(Method(self.ablated, scale) for scale in others))

    def settings(self, place: ScenePlace) -> tuple[int, ...]:
        """Numbers of references of a scene, DENSE first, then the densest.

        Raises:
            UsageError: sparse is wanted of a scene of no benchmark, without numbers.
        """
        sparse: tuple[int, ...] = ()
        if "sparse" in self.protocols:
            if not self.sparse and place.benchmark is None:
                raise UsageError(f"{place.name} is no benchmark's scene: say how sparse, --sparse 5,10,20,30")
            sparse = self.sparse or (place.benchmark.sparse if place.benchmark else ())
        return (*((DENSE,) if "dense" in self.protocols else ()), *sorted(set(sparse), reverse=True))


@dataclass(frozen=True)
class Method:
    """A form of the method."""

    variant: str
    scale: str

    @property
    def label(self) -> str:
        """For people; the paper's scale strategy goes without saying."""
        return self.variant if self.scale == "two_stage" else f"{self.variant}, {self.scale}"


@dataclass(frozen=True, eq=False)
class SceneSplit:
    """Who is who in one setting of a scene.

    Attributes:
        setting: number of references that was asked for; DENSE for all.
        test_count: queries that the benchmark has, of which `queries` may be a part.
    """

    setting: int
    references: tuple[Frame, ...]
    queries: tuple[Frame, ...]
    test_count: int


def setting_name(setting: int) -> str:
    """For people: "dense" or "N=10"."""
    return "dense" if setting == DENSE else f"N={setting}"


def split_scene(dataset: Dataset, setting: int, options: SuiteOptions) -> SceneSplit:
    """References and queries of a scene in a setting.

    A folder with cameras.json may have no split; sparse, it is then split as `split_frames` does.

    Raises:
        UsageError: the dataset has no split, or fewer training frames than are asked for.
    """
    train = [frame for frame in dataset.frames if frame.split == "train"]
    test = [frame for frame in dataset.frames if frame.split == "test"]
    if setting != DENSE and not train and not test and dataset.format == "cameras":
        split = split_frames(len(dataset.frames), EvaluationOptions(setting, options.max_queries))
        references, queries = ([dataset.frames[i] for i in part] for part in (split.references, split.queries))
        return SceneSplit(setting, tuple(references), tuple(queries), len(dataset.frames) - len(references))
    for name, frames in (("train", train), ("test", test)):
        if not frames:
            raise UsageError(f"{dataset.name} has no frame of the {name} split: is its file of the split there?")
    if setting == DENSE:
        references = train[:: options.stride]
        if len(references) < 2:
            raise UsageError(f"{dataset.name}: a stride of {options.stride} leaves 1 of {len(train)} references")
    else:
        if setting > len(train):
            raise UsageError(f"{dataset.name} has {len(train)} training frames, {setting} references are wanted")
        references = uniform(train, setting)
    queries = test if options.max_queries is None else uniform(test, options.max_queries)
    if options.choice == "matches" and len(references) > MAX_MATCHED:
        raise UsageError(
            f"{dataset.name}: {len(references)} references are too many to compare with each query; use "
            "--choose retrieval, or a --stride"
        )
    if options.choice == "given" and len(references) > MAX_K:
        raise UsageError(
            f"{dataset.name}: a query can be given {MAX_K} references at most, not {len(references)}; use --choose "
            "retrieval, or --protocol sparse"
        )
    return SceneSplit(setting, tuple(references), tuple(queries), len(test))


def uniform(frames: Sequence[Frame], count: int) -> list[Frame]:
    """`count` of the frames, evenly spread from the first to the last; all if there are no more."""
    if count >= len(frames):
        return list(frames)
    return [frames[i] for i in np.round(np.linspace(0, len(frames) - 1, count)).astype(int)]
