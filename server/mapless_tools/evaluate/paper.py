"""The figures of the paper's tables, for its own method and the others, as printed there.

Yu Zhang et al., "L3: Scene-agnostic Visual Localization in the Wild". Its ground truth indoors is SfM pseudo ground
truth (Brachmann et al., ICCV 2021), outdoors the benchmark's own; figures against another are not comparable.

A line of a table: the method; its group; the dense median error of each scene, cm/degrees; its mean over all scenes
with all references, then with ever fewer ("-": it failed in at least one scene); the share of queries within an error.
"""
# ruff: noqa: E501

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

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


def _method(line: str, scenes: tuple[str, ...], counts: tuple[int, ...]) -> PaperMethod:
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


def _methods(table: str, scenes: tuple[str, ...], counts: tuple[int, ...]) -> tuple[PaperMethod, ...]:
    return tuple(_method(line, scenes, counts) for line in table.strip().splitlines())


SEVEN_SCENES = PaperTables(
    "Results on 7Scenes dataset",
    "Sparse view localization on the 7Scenes and 12Scenes datasets",
    _methods(
        """
PoseNet         | APR  |  10/4.02    27/10    18/13  17/5.97  19/4.67  22/5.91  35/10.5 |  21/7.74
DFNet           | APR  |   3/1.12    6/2.3   4/2.29   6/1.54   7/1.92   7/1.74  12/2.63 |   6/1.93
Marepo          | APR  | 1.9/0.83 2.3/0.92 2.1/1.24 2.9/0.93 2.5/0.88 2.9/0.98 5.9/1.48 | 2.9/1.04
DSAC*           | SCR  | 0.5/0.17 0.8/0.28 0.5/0.34 1.2/0.34 1.2/0.28 0.7/0.21 2.7/0.78 | 1.1/0.34
ACE             | SCR  | 0.5/0.19 0.8/0.33 0.5/0.33 1.1/0.29 1.1/0.22  0.8/0.2  2.9/0.8 | 1.1/0.34 2.7/0.65 3.2/0.79 9.2/1.53 348.7/4.78
GLACE           | SCR  | 0.6/0.18 0.9/0.34 0.6/0.35   1/0.29 0.9/0.23  0.8/0.2 3.1/0.95 | 1.1/0.36
pNeRFLoc        | NVS  |    2/0.8   2/0.88   1/0.83   3/1.05   6/1.51   5/1.54  32/5.73 | 7.3/1.76
DFNet + NeFeS50 | NVS  |   2/0.57   2/0.74   2/1.28   2/0.56   2/0.55   2/0.57   5/1.28 | 2.4/0.79
HR-APR          | NVS  |   2/0.55   2/0.75   2/1.45   2/0.64   2/0.62   2/0.67    5/1.3 | 2.4/0.85
NeRFMatch       | NVS  |  0.9/0.3  1.1/0.4    1.5/1    3/0.8  2.2/0.6    1/0.3 10.1/1.7 |  2.8/0.7
MCLoc           | NVS  |    2/0.8    3/1.4    3/1.3    4/1.3    5/1.6    6/1.6      6/2 | 4.1/1.43
ACE + GS-CPR    | NVS  | 0.5/0.15 0.6/0.25 0.4/0.28 0.9/0.26   1/0.23 0.7/0.17 1.4/0.42 | 0.8/0.25 1.5/0.42 1.6/0.46 5.2/1.33        -
L3 coarse       | ours |                                                                | 2.5/0.71 3.7/1.02 4.3/1.17 5.7/1.52 6.4/1.65
L3 w/o optim.   | ours |                                                                | 2.5/0.67 2.8/0.79 3.1/0.84 5.1/1.42 6.5/1.66
L3              | ours | 0.6/0.21 1.2/0.46 0.7/0.41 1.1/0.32 1.4/0.34   1/0.26 3.1/0.87 | 1.3/0.41 1.9/0.56 2.3/0.63 4.5/1.26 5.9/1.61
""",
        ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs"),
        (30, 20, 10, 5),
    ),
)

TWELVE_SCENES = PaperTables(
    "Results on 12Scenes dataset",
    "Sparse view localization on the 7Scenes and 12Scenes datasets",
    _methods(
        """
Marepo        | APR  |  |   2.1/1.04                                             | 5cm_5deg 95
ACE           | SCR  |  |   0.7/0.26  12.5/1.32  51.3/3.76 837.9/12.1 2950/20.63 | 5cm_5deg 100 1cm_1deg 75.1
GLACE         | SCR  |  |   0.7/0.25                                             | 5cm_5deg 100 1cm_1deg 78.7
ACE + GS-CPR  | NVS  |  |   0.5/0.21  21.3/0.95          -          -          - | 5cm_5deg 100 1cm_1deg 86.7
L3 coarse     | ours |  |     1/0.36    2.6/0.9   3.5/1.12  10.8/2.52  16.9/2.56
L3 w/o optim. | ours |  |   0.7/0.25   1.6/0.54   2.8/0.94  10.7/2.53  17.2/2.57
L3            | ours |  |   0.4/0.19   1.4/0.53   2.7/0.93  10.2/2.51  16.9/2.56 | 5cm_5deg 99.5 1cm_1deg 86.7
""",
        (),
        (30, 20, 10, 5),
    ),
)

CAMBRIDGE = PaperTables(
    "Results on Cambridge Landmarks dataset",
    "Results of sparse view localization on the Cambridge dataset",
    _methods(
        """
AS (SIFT)       | FM   |   13/0.2   20/0.4    4/0.2    8/0.3 |  11/0.28
HLoc (SP+SG)    | FM   |   12/0.2   15/0.3    4/0.2    7/0.2 |  10/0.23
ImLoc           | FM   |   11/0.2   14/0.3    4/0.2    7/0.2 |   9/0.23
LENS            | APR  |   33/0.5   44/0.9   27/1.6   53/1.6 |  39/1.15
DFNet           | APR  |  73/2.37 200/2.98  67/2.21 137/4.03 |  119/2.9
PMNet           | APR  |  68/1.97 103/1.31   58/2.1 133/3.73 |  90/2.27
DSAC*           | SCR  |   15/0.3   21/0.4    5/0.3   13/0.4 |  14/0.35
ACE             | SCR  |  28/0.37  32/0.63   5/0.28   19/0.6 |  21/0.47   83/1.7 122/2.85 111/2.43 261/5.65
GLACE           | SCR  |  18/0.32  19/0.42   5/0.22   9/0.29 |  13/0.31
CrossFire       | NVS  |   47/0.7   43/0.7   20/1.2   39/1.4 |     37/1
DFNet + NeFeS50 | NVS  |  37/0.54  52/0.88  15/0.53  37/1.14 |  35/0.77
HR-APR          | NVS  |  36/0.58  53/0.89  13/0.51  38/1.16 |  35/0.78
MCLoc           | NVS  |  31/0.42  39/0.73  12/0.45  26/0.88 |  27/0.62
ACE + GS-CPR    | NVS  |  20/0.29   21/0.4   5/0.24   13/0.4 |  15/0.33   41/1.1  72/2.13  88/5.41 350/8.63
L3 coarse       | ours |                                     |  36/0.54  42/0.64  40/0.64  56/0.68  54/0.76
L3 w/o optim.   | ours |                                     |  15/0.33  23/0.46  20/0.53  23/0.47  34/0.66
L3              | ours |  13/0.22   15/0.3   5/0.23   9/0.31 |  11/0.27  18/0.39  17/0.37  20/0.42  25/0.53
""",
        ("KingsCollege", "OldHospital", "ShopFacade", "StMarysChurch"),
        (60, 50, 40, 30),
    ),
)
