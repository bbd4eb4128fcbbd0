"""The figures of the paper's tables, for its own method and the others, as printed there.

Yu Zhang et al., "L3: Scene-agnostic Visual Localization in the Wild". Its ground truth indoors is SfM pseudo ground
truth (Brachmann et al., ICCV 2021), outdoors the benchmark's own; figures against another are not comparable.

`paper.json` has the lines of the tables as texts: the method; its group; the dense median error of each scene,
cm/degrees; its mean over all scenes with all references, then with ever fewer ("-": it failed in at least one scene);
the share of queries within an error.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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
class PaperTables:
    """The paper's tables of a benchmark: their titles, and the methods in the paper's order."""

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


def _tables(content: dict[str, Any]) -> PaperTables:
    methods = tuple(_method(line, content["scenes"], content["counts"]) for line in content["methods"])
    return PaperTables(content["dense_table"], content["sparse_table"], methods)


_FILE = Path(__file__).with_name("paper.json")
PAPER: Mapping[str, PaperTables] = {name: _tables(it) for name, it in json.loads(_FILE.read_text()).items()}
"""The tables of each benchmark, by its layout."""
