"""The paper's benchmarks: their scenes, its figures for its own method and others, and where scenes are in a folder.

Yu Zhang et al., "L3: Scene-agnostic Visual Localization in the Wild". Its ground truth indoors is SfM pseudo ground
truth (Brachmann et al., ICCV 2021), outdoors the benchmark's own; figures against another are not comparable.

`paper.json` has them; the lines of its tables are texts: the method; its group; the dense median error of each scene,
cm/degrees; its mean over all scenes with all references, then with ever fewer ("-": it failed in at least one scene);
the share of queries within an error.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mapless_tools.ingest.formats import fits
from mapless_tools.usage import UsageError

Median = tuple[float, float]
"""Translation in cm, rotation in degrees."""
DENSE = 0
"""Stands for all references where a number of references is asked for."""
VARIANT_OF = {"L3 coarse": "coarse", "L3 w/o optim.": "no_structure", "L3": "full"}
"""The variant here that a method of the paper corresponds to."""


@dataclass(frozen=True)
class PaperMethod:
    """A line of the paper's tables: a method and its group (FM, APR, SCR, NVS or "ours").

    Its figures are dense medians by scene, means of the medians over all scenes by number of references (None for a
    failure in at least one scene), and the share of queries within an error ("5cm_5deg"), dense, averaged over scenes.
    """

    name: str
    kind: str
    scenes: Mapping[str, Median] = field(default_factory=dict)
    average: Mapping[int, Median | None] = field(default_factory=dict)
    recall_percent: Mapping[str, float] = field(default_factory=dict)

    @property
    def variant(self) -> str:
        """The corresponding variant here; empty for other methods."""
        return VARIANT_OF.get(self.name, "")


@dataclass(frozen=True)
class Benchmark:
    """A benchmark of the paper, the layout of its scenes on the disk, and the paper's tables of it.

    `scenes` are names in the tables by name of the folder, in the paper's order; `sparse` numbers of references that
    the paper keeps, the densest first; `ground_truth` that of its figures. Methods are in the paper's order.
    """

    layout: str
    title: str
    scenes: dict[str, str]
    sparse: tuple[int, ...]
    ground_truth: str
    dense_table: str
    sparse_table: str
    methods: tuple[PaperMethod, ...]


def _method(line: str, scenes: Sequence[str], counts: Sequence[int]) -> PaperMethod:
    name, kind, medians, averages, recall = (*(cell.strip() for cell in line.split("|")), "", "", "")[:5]
    by_scene = zip(scenes, map(_median, medians.split()), strict=bool(medians))
    words = recall.split()
    return PaperMethod(
        name,
        kind,
        {scene: median for scene, median in by_scene if median is not None},
        dict(zip((DENSE, *counts), map(_median, averages.split()), strict=False)),
        dict(zip(words[::2], map(float, words[1::2]), strict=True)),
    )


def _median(text: str) -> Median | None:
    if text == "-":
        return None
    translation_cm, _, rotation_deg = text.partition("/")
    return float(translation_cm), float(rotation_deg)


def _benchmark(layout: str, content: dict[str, Any]) -> Benchmark:
    methods = tuple(_method(line, list(content["scenes"]), content["sparse"]) for line in content["methods"])
    return Benchmark(layout, **content | {"methods": methods, "sparse": tuple(content["sparse"])})


_FILE = Path(__file__).with_name("paper.json")
BENCHMARKS = {layout: _benchmark(layout, it) for layout, it in json.loads(_FILE.read_text(encoding="utf-8")).items()}
"""By the layout."""
MAX_DEPTH = 2
"""12-Scenes keeps its rooms in folders of buildings."""

_MARKS = {
    "7scenes": "seq-01 and so on with TrainSplit.txt and TestSplit.txt",
    "12scenes": "data, info.txt and split.txt",
    "cambridge": "dataset_train.txt and dataset_test.txt",
    "cameras": "cameras.json",
}

LAYOUTS = ("auto", *BENCHMARKS, "cameras")
"""Values of `--layout`."""


@dataclass(frozen=True)
class ScenePlace:
    """A scene on the disk.

    Its name is the paper's folder name, if it has one, in any case, and unique among the found ones.
    """

    name: str
    path: Path
    layout: str

    @property
    def benchmark(self) -> Benchmark | None:
        """The benchmark whose layout it has; None for a folder with cameras.json."""
        return BENCHMARKS.get(self.layout)


def find_scenes(folder: Path, layout: str = "auto") -> tuple[ScenePlace, ...]:
    """The scene that a folder is, or those in it, in the paper's order, others after; UsageError if there is none."""
    if layout not in LAYOUTS:
        raise UsageError(f"layout must be one of {', '.join(LAYOUTS)}, not {layout!r}")
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder")
    wanted = LAYOUTS[1:] if layout == "auto" else (layout,)
    found, other = _search(folder, wanted, MAX_DEPTH)
    if not found:
        marks = ", or ".join(f"{_MARKS[name]} ({name})" for name in wanted)
        seen = f"; what is there has the layout {other}" if other else ""
        raise UsageError(f"{folder} is no scene, nor are the folders in it: a scene has {marks}{seen}")
    places = [ScenePlace(_name(path, folder, its), path, its) for path, its in found]
    return tuple(sorted(places, key=_order))


def _search(folder: Path, wanted: tuple[str, ...], depth: int) -> tuple[list[tuple[Path, str]], str]:
    """Finds scenes with their layouts; also returns a layout that was found but is not wanted."""
    layout = _layout(folder, wanted)
    if layout in wanted:
        return [(folder, layout)], ""
    if layout or not depth:
        return [], layout
    found: list[tuple[Path, str]] = []
    other = ""
    for child in sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")):
        scenes, seen = _search(child, wanted, depth - 1)
        found += scenes
        other = other or seen
    return found, other


def _layout(folder: Path, wanted: tuple[str, ...]) -> str:
    found = [layout for layout in _MARKS if fits(folder, layout)]
    return next((layout for layout in found if layout in wanted), next(iter(found), ""))


def _name(path: Path, folder: Path, layout: str) -> str:
    """The paper's folder name if the path ends like it, else the path from the folder that was given."""
    path = path.resolve()
    tail = "/".join(path.parts[-2:]).lower()
    for name in BENCHMARKS[layout].scenes if layout in BENCHMARKS else ():
        if tail == name.lower() or tail.endswith("/" + name.lower()):
            return name
    relative = path.relative_to(folder.resolve()).as_posix()
    return path.name if relative == "." else relative


def _order(place: ScenePlace) -> tuple[str, int, str]:
    known = list(place.benchmark.scenes) if place.benchmark else []
    return place.layout, known.index(place.name) if place.name in known else len(known), place.name
