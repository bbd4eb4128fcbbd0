"""The plan of an evaluation: which frames are references and queries, in which settings, and by which methods.

A benchmark's references are the frames of its training split and its queries those of its test split. In the dense
setting all training frames are references; in a sparse one N of them, evenly spread. A folder without a split is
evaluated by leaving one out, or with N evenly spread references and queries between them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mapless_server.method.options import ScaleStrategy, Variant
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.usage import UsageError

from .benchmarks import DENSE, LAYOUTS, ScenePlace

T = TypeVar("T")

MAX_K = 64
"""Most references that one call of Localize takes."""
QUERY_MARGIN = 3
"""Queries beside references keep this far from the first and the last frame, so that they lie within the walk."""
DEFAULT_QUERY_COUNT = 40
PROTOCOLS = ("dense", "sparse")
CHOICES = ("retrieval", "matches", "given")
VARIANTS = tuple(variant.value for variant in Variant)
SCALES = tuple(strategy.value for strategy in ScaleStrategy)
MAX_MATCHED = 1000
"""Comparing a query with each reference's features takes 20 ms each: beyond this it is retrieval's job."""


@dataclass(frozen=True)
class EvaluationOptions:
    """Options of an evaluation.

    The references are so many frames, evenly spread; None leaves one out: every frame is localized from all others. The
    queries are evenly spread, too; None for 40 beside references, else for all frames.
    """

    reference_count: int | None = None
    query_count: int | None = None
    k: int = 10
    variant: str = "best"
    scale_strategy: str = "two_stage"

    def __post_init__(self) -> None:
        if self.reference_count is not None and self.reference_count < 2:
            raise ValueError(f"at least 2 references are needed for a baseline, not {self.reference_count}")
        if self.query_count is not None and self.query_count < 1:
            raise ValueError(f"at least 1 query is needed, not {self.query_count}")
        _check_k(self.k)
        _check_known("variant", [self.variant], VARIANTS)
        _check_known("scale", [self.scale_strategy], SCALES)


@dataclass(frozen=True)
class SuiteOptions:
    """Options of an evaluation as in the paper.

    Attributes:
        sparse: numbers of references; empty for those of the paper.
        variants: forms of the method, each with the first of `scales`.
        scales: strategies of the metric scale; those after the first are run only with the variant `ablated`.
        stride: in the dense setting every n-th training frame is a reference; 1, as in the paper, for all.
        max_queries: largest number of queries of a scene, evenly spread; None, as in the paper, for all.
        choice: how a query's references are chosen: by the server's "retrieval", as for a request that names none; by
            feature "matches" counted here; or all are "given", in the order they were taken, without a ranking.
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
        _check_known("layout", [self.layout], LAYOUTS)
        _check_known("protocol", self.protocols, PROTOCOLS)
        _check_known("variant", self.variants, VARIANTS)
        _check_known("scale", self.scales, SCALES)
        _check_known("references", [self.choice], CHOICES)
        if any(count < 2 for count in self.sparse):
            raise ValueError(f"sparse: at least 2 references are needed for a baseline, not {min(self.sparse)}")
        _check_k(self.k)
        if self.stride < 1:
            raise ValueError(f"stride must be at least 1, not {self.stride}")
        if self.max_queries is not None and self.max_queries < 1:
            raise ValueError(f"max-queries must be at least 1, not {self.max_queries}")

    @property
    def ablated(self) -> str:
        """The variant whose scale is varied: the paper's own if it is among the variants."""
        return "full" if "full" in self.variants else self.variants[0]

    def methods(self) -> "tuple[Method, ...]":
        """The methods of every setting: each variant, then the ablation of the scale."""
        first, *others = self.scales
        return (*(Method(v, first) for v in self.variants), *(Method(self.ablated, scale) for scale in others))

    def settings(self, place: ScenePlace) -> tuple[int, ...]:
        """Numbers of references of a scene: DENSE, then in decreasing order; UsageError if sparse ones are unknown."""
        sparse: tuple[int, ...] = ()
        if "sparse" in self.protocols:
            if not self.sparse and place.benchmark is None:
                raise UsageError(
                    f"{place.name} is no benchmark's scene: give the numbers of references, --sparse 5,10,20,30"
                )
            sparse = self.sparse or (place.benchmark.sparse if place.benchmark else ())
        return (*((DENSE,) if "dense" in self.protocols else ()), *sorted(set(sparse), reverse=True))


@dataclass(frozen=True)
class Method:
    """A form of the method."""

    variant: str
    scale: str

    @property
    def label(self) -> str:
        """Label of the method; the paper's scale strategy is omitted."""
        return self.variant if self.scale == "two_stage" else f"{self.variant}, {self.scale}"


@dataclass(frozen=True, eq=False)
class SceneSplit:
    """References and queries of a scene; the setting is the number of references, DENSE for all.

    The queries may be a part of the benchmark's, which are `test_count`.
    """

    setting: int
    references: tuple[Frame, ...]
    queries: tuple[Frame, ...]
    test_count: int


def setting_name(setting: int) -> str:
    """Name of a setting: "dense" or "N=10"."""
    return "dense" if setting == DENSE else f"N={setting}"


def split_frames(frames: Sequence[T], options: EvaluationOptions) -> tuple[tuple[T, ...], tuple[T, ...]]:
    """References and queries of F frames, each in their order and without repetition; UsageError if there are too few.

    With N references: those at round(linspace(0, F - 1, N)), and those of round(linspace(3, F - 4, M)) that are not
    references as queries; fewer than 8 frames have no room for that margin, there it is round(linspace(0, F - 1, M)).
    Without N, every frame is a reference of all others.
    """
    count = len(frames)
    if options.reference_count is None:
        if count < 3:
            raise UsageError(f"leaving one out needs at least 3 frames, the folder has {count}")
        return tuple(frames), tuple(evenly_spread(frames, options.query_count))
    if options.reference_count > count:
        raise UsageError(f"{options.reference_count} references are wanted, the folder has {count} frames")
    references = _spread(0, count - 1, options.reference_count)
    margin = QUERY_MARGIN if count >= 8 else 0
    wanted = DEFAULT_QUERY_COUNT if options.query_count is None else options.query_count
    queries = [i for i in _spread(margin, count - 1 - margin, wanted) if i not in references]
    if not queries:
        raise UsageError(
            f"with {options.reference_count} references among {count} frames no frame is left as a query; take fewer "
            "references, more queries, or leave one out"
        )
    return tuple(frames[i] for i in references), tuple(frames[i] for i in queries)


def split_scene(dataset: Dataset, setting: int, options: SuiteOptions) -> SceneSplit:
    """Splits a scene into references and queries.

    UsageError if it has no split, or fewer training frames than asked for. A folder with cameras.json may have no
    split; sparse, it is then split as `split_frames` does.
    """
    train = [frame for frame in dataset.frames if frame.split == "train"]
    test = [frame for frame in dataset.frames if frame.split == "test"]
    if setting != DENSE and not train and not test and dataset.format == "cameras":
        split = split_frames(dataset.frames, EvaluationOptions(setting, options.max_queries))
        return SceneSplit(setting, *split, len(dataset.frames) - setting)
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
        references = evenly_spread(train, setting)
    queries = evenly_spread(test, options.max_queries)
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


def evenly_spread(items: Sequence[T], count: int | None) -> list[T]:
    """Selects `count` items, evenly spread from the first to the last; all if there are fewer, or for None."""
    if count is None or count >= len(items):
        return list(items)
    return [items[i] for i in _spread(0, len(items) - 1, count)]


def _spread(first: int, last: int, count: int) -> list[int]:
    """`count` whole numbers evenly from `first` to `last`, rounded half to even; fewer where they coincide."""
    return list(dict.fromkeys(np.round(np.linspace(first, last, count)).astype(int).tolist()))


def _check_k(k: int) -> None:
    if not 1 <= k <= MAX_K:
        raise ValueError(f"k, the references of a query, must be 1 to {MAX_K}, not {k}")


def _check_known(field: str, values: Iterable[str], known: Sequence[str]) -> None:
    values = list(values)
    unknown = [value for value in values if value not in known]
    if unknown or not values:
        raise ValueError(f"{field} must be one of {', '.join(known)}, not {', '.join(map(repr, unknown)) or '-'}")
    if len(set(values)) < len(values):
        raise ValueError(f"{field}: {', '.join(values)} names one twice")
