"""The figures of the paper's tables, its own method's and the rivals', as printed there.

Yu Zhang et al., "L3: Scene-agnostic Visual Localization in the Wild". Each median is (translation, cm; rotation,
degrees), as printed: what the paper rounds is rounded here. Its ground truth indoors is SfM pseudo ground truth
(Brachmann et al., ICCV 2021), outdoors the benchmark's own; figures against another are not comparable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

Median = tuple[float, float]
"""Translation in cm, rotation in degrees."""

DENSE = 0
"""Stands for all references where a number of references is asked for."""


@dataclass(frozen=True)
class PaperMethod:
    """A line of the paper's tables.

    Attributes:
        name: as printed.
        kind: the paper's group: FM, APR, SCR, NVS or "ours".
        scenes: dense medians by scene, under the scene's column.
        average: mean of the medians over all scenes by number of references (DENSE for all); None where the paper has
            "-", failure in at least one scene.
        recall_percent: share of queries within (cm, degrees), dense, averaged over scenes.
        variant: the variant here that it corresponds to; empty for rivals.
    """

    name: str
    kind: str
    scenes: Mapping[str, Median] = field(default_factory=dict)
    average: Mapping[int, Median | None] = field(default_factory=dict)
    recall_percent: Mapping[str, float] = field(default_factory=dict)
    variant: str = ""


@dataclass(frozen=True)
class PaperTables:
    """What the paper has on a benchmark.

    Attributes:
        dense_table, sparse_table: the tables' titles.
        methods: in the paper's order.
    """

    dense_table: str
    sparse_table: str
    methods: tuple[PaperMethod, ...]


_SEVEN_SCENES = ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs")
_CAMBRIDGE = ("KingsCollege", "OldHospital", "ShopFacade", "StMarysChurch")


def _seven(*medians: Median) -> Mapping[str, Median]:
    return dict(zip(_SEVEN_SCENES, medians, strict=True))


def _cambridge(*medians: Median) -> Mapping[str, Median]:
    return dict(zip(_CAMBRIDGE, medians, strict=True))


def _sparse(counts: tuple[int, ...], *medians: Median | None) -> Mapping[int, Median | None]:
    return dict(zip((DENSE, *counts), medians, strict=True))


_INDOORS = (30, 20, 10, 5)
_OUTDOORS = (60, 50, 40, 30)

SEVEN_SCENES = PaperTables(
    "Results on 7Scenes dataset",
    "Sparse view localization on the 7Scenes and 12Scenes datasets",
    (
        PaperMethod(
            "PoseNet",
            "APR",
            _seven((10, 4.02), (27, 10.0), (18, 13.0), (17, 5.97), (19, 4.67), (22, 5.91), (35, 10.5)),
            {DENSE: (21, 7.74)},
        ),
        PaperMethod(
            "DFNet",
            "APR",
            _seven((3, 1.12), (6, 2.30), (4, 2.29), (6, 1.54), (7, 1.92), (7, 1.74), (12, 2.63)),
            {DENSE: (6, 1.93)},
        ),
        PaperMethod(
            "Marepo",
            "APR",
            _seven((1.9, 0.83), (2.3, 0.92), (2.1, 1.24), (2.9, 0.93), (2.5, 0.88), (2.9, 0.98), (5.9, 1.48)),
            {DENSE: (2.9, 1.04)},
        ),
        PaperMethod(
            "DSAC*",
            "SCR",
            _seven((0.5, 0.17), (0.8, 0.28), (0.5, 0.34), (1.2, 0.34), (1.2, 0.28), (0.7, 0.21), (2.7, 0.78)),
            {DENSE: (1.1, 0.34)},
        ),
        PaperMethod(
            "ACE",
            "SCR",
            _seven((0.5, 0.19), (0.8, 0.33), (0.5, 0.33), (1.1, 0.29), (1.1, 0.22), (0.8, 0.20), (2.9, 0.80)),
            _sparse(_INDOORS, (1.1, 0.34), (2.7, 0.65), (3.2, 0.79), (9.2, 1.53), (348.7, 4.78)),
        ),
        PaperMethod(
            "GLACE",
            "SCR",
            _seven((0.6, 0.18), (0.9, 0.34), (0.6, 0.35), (1.0, 0.29), (0.9, 0.23), (0.8, 0.20), (3.1, 0.95)),
            {DENSE: (1.1, 0.36)},
        ),
        PaperMethod(
            "pNeRFLoc",
            "NVS",
            _seven((2, 0.8), (2, 0.88), (1, 0.83), (3, 1.05), (6, 1.51), (5, 1.54), (32, 5.73)),
            {DENSE: (7.3, 1.76)},
        ),
        PaperMethod(
            "DFNet + NeFeS50",
            "NVS",
            _seven((2, 0.57), (2, 0.74), (2, 1.28), (2, 0.56), (2, 0.55), (2, 0.57), (5, 1.28)),
            {DENSE: (2.4, 0.79)},
        ),
        PaperMethod(
            "HR-APR",
            "NVS",
            _seven((2, 0.55), (2, 0.75), (2, 1.45), (2, 0.64), (2, 0.62), (2, 0.67), (5, 1.30)),
            {DENSE: (2.4, 0.85)},
        ),
        PaperMethod(
            "NeRFMatch",
            "NVS",
            _seven((0.9, 0.3), (1.1, 0.4), (1.5, 1.0), (3.0, 0.8), (2.2, 0.6), (1.0, 0.3), (10.1, 1.7)),
            {DENSE: (2.8, 0.7)},
        ),
        PaperMethod(
            "MCLoc",
            "NVS",
            _seven((2, 0.8), (3, 1.4), (3, 1.3), (4, 1.3), (5, 1.6), (6, 1.6), (6, 2.0)),
            {DENSE: (4.1, 1.43)},
        ),
        PaperMethod(
            "ACE + GS-CPR",
            "NVS",
            _seven((0.5, 0.15), (0.6, 0.25), (0.4, 0.28), (0.9, 0.26), (1.0, 0.23), (0.7, 0.17), (1.4, 0.42)),
            _sparse(_INDOORS, (0.8, 0.25), (1.5, 0.42), (1.6, 0.46), (5.2, 1.33), None),
        ),
        PaperMethod(
            "L3 coarse",
            "ours",
            average=_sparse(_INDOORS, (2.5, 0.71), (3.7, 1.02), (4.3, 1.17), (5.7, 1.52), (6.4, 1.65)),
            variant="coarse",
        ),
        PaperMethod(
            "L3 w/o optim.",
            "ours",
            average=_sparse(_INDOORS, (2.5, 0.67), (2.8, 0.79), (3.1, 0.84), (5.1, 1.42), (6.5, 1.66)),
            variant="no_structure",
        ),
        PaperMethod(
            "L3",
            "ours",
            _seven((0.6, 0.21), (1.2, 0.46), (0.7, 0.41), (1.1, 0.32), (1.4, 0.34), (1.0, 0.26), (3.1, 0.87)),
            _sparse(_INDOORS, (1.3, 0.41), (1.9, 0.56), (2.3, 0.63), (4.5, 1.26), (5.9, 1.61)),
            variant="full",
        ),
    ),
)

TWELVE_SCENES = PaperTables(
    "Results on 12Scenes dataset",
    "Sparse view localization on the 7Scenes and 12Scenes datasets",
    (
        PaperMethod("Marepo", "APR", average={DENSE: (2.1, 1.04)}, recall_percent={"5cm_5deg": 95}),
        PaperMethod(
            "ACE",
            "SCR",
            average=_sparse(_INDOORS, (0.7, 0.26), (12.5, 1.32), (51.3, 3.76), (837.9, 12.1), (2950, 20.63)),
            recall_percent={"5cm_5deg": 100, "1cm_1deg": 75.1},
        ),
        PaperMethod("GLACE", "SCR", average={DENSE: (0.7, 0.25)}, recall_percent={"5cm_5deg": 100, "1cm_1deg": 78.7}),
        PaperMethod(
            "ACE + GS-CPR",
            "NVS",
            average=_sparse(_INDOORS, (0.5, 0.21), (21.3, 0.95), None, None, None),
            recall_percent={"5cm_5deg": 100, "1cm_1deg": 86.7},
        ),
        PaperMethod(
            "L3 coarse",
            "ours",
            average=_sparse(_INDOORS, (1.0, 0.36), (2.6, 0.90), (3.5, 1.12), (10.8, 2.52), (16.9, 2.56)),
            variant="coarse",
        ),
        PaperMethod(
            "L3 w/o optim.",
            "ours",
            average=_sparse(_INDOORS, (0.7, 0.25), (1.6, 0.54), (2.8, 0.94), (10.7, 2.53), (17.2, 2.57)),
            variant="no_structure",
        ),
        PaperMethod(
            "L3",
            "ours",
            average=_sparse(_INDOORS, (0.4, 0.19), (1.4, 0.53), (2.7, 0.93), (10.2, 2.51), (16.9, 2.56)),
            recall_percent={"5cm_5deg": 99.5, "1cm_1deg": 86.7},
            variant="full",
        ),
    ),
)

CAMBRIDGE = PaperTables(
    "Results on Cambridge Landmarks dataset",
    "Results of sparse view localization on the Cambridge dataset",
    (
        PaperMethod("AS (SIFT)", "FM", _cambridge((13, 0.2), (20, 0.4), (4, 0.2), (8, 0.3)), {DENSE: (11, 0.28)}),
        PaperMethod("HLoc (SP+SG)", "FM", _cambridge((12, 0.2), (15, 0.3), (4, 0.2), (7, 0.2)), {DENSE: (10, 0.23)}),
        PaperMethod("ImLoc", "FM", _cambridge((11, 0.2), (14, 0.3), (4, 0.2), (7, 0.2)), {DENSE: (9, 0.23)}),
        PaperMethod("LENS", "APR", _cambridge((33, 0.5), (44, 0.9), (27, 1.6), (53, 1.6)), {DENSE: (39, 1.15)}),
        PaperMethod("DFNet", "APR", _cambridge((73, 2.37), (200, 2.98), (67, 2.21), (137, 4.03)), {DENSE: (119, 2.90)}),
        PaperMethod("PMNet", "APR", _cambridge((68, 1.97), (103, 1.31), (58, 2.10), (133, 3.73)), {DENSE: (90, 2.27)}),
        PaperMethod("DSAC*", "SCR", _cambridge((15, 0.3), (21, 0.4), (5, 0.3), (13, 0.4)), {DENSE: (14, 0.35)}),
        PaperMethod(
            "ACE",
            "SCR",
            _cambridge((28, 0.37), (32, 0.63), (5, 0.28), (19, 0.60)),
            _sparse(_OUTDOORS, (21, 0.47), (83, 1.70), (122, 2.85), (111, 2.43), (261, 5.65)),
        ),
        PaperMethod("GLACE", "SCR", _cambridge((18, 0.32), (19, 0.42), (5, 0.22), (9, 0.29)), {DENSE: (13, 0.31)}),
        PaperMethod("CrossFire", "NVS", _cambridge((47, 0.7), (43, 0.7), (20, 1.2), (39, 1.4)), {DENSE: (37, 1)}),
        PaperMethod(
            "DFNet + NeFeS50", "NVS", _cambridge((37, 0.54), (52, 0.88), (15, 0.53), (37, 1.14)), {DENSE: (35, 0.77)}
        ),
        PaperMethod("HR-APR", "NVS", _cambridge((36, 0.58), (53, 0.89), (13, 0.51), (38, 1.16)), {DENSE: (35, 0.78)}),
        PaperMethod("MCLoc", "NVS", _cambridge((31, 0.42), (39, 0.73), (12, 0.45), (26, 0.88)), {DENSE: (27, 0.62)}),
        PaperMethod(
            "ACE + GS-CPR",
            "NVS",
            _cambridge((20, 0.29), (21, 0.40), (5, 0.24), (13, 0.40)),
            _sparse(_OUTDOORS, (15, 0.33), (41, 1.10), (72, 2.13), (88, 5.41), (350, 8.63)),
        ),
        PaperMethod(
            "L3 coarse",
            "ours",
            average=_sparse(_OUTDOORS, (36, 0.54), (42, 0.64), (40, 0.64), (56, 0.68), (54, 0.76)),
            variant="coarse",
        ),
        PaperMethod(
            "L3 w/o optim.",
            "ours",
            average=_sparse(_OUTDOORS, (15, 0.33), (23, 0.46), (20, 0.53), (23, 0.47), (34, 0.66)),
            variant="no_structure",
        ),
        PaperMethod(
            "L3",
            "ours",
            _cambridge((13, 0.22), (15, 0.30), (5, 0.23), (9, 0.31)),
            _sparse(_OUTDOORS, (11, 0.27), (18, 0.39), (17, 0.37), (20, 0.42), (25, 0.53)),
            variant="full",
        ),
    ),
)
