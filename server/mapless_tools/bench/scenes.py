"""The scenes of the benchmark, with the target on each and the accuracy that a map reaches."""

from __future__ import annotations

from dataclasses import dataclass

from mapless_tools.evaluate.metrics import Summary


@dataclass(frozen=True)
class Figures:
    """Median errors, and the number of localized queries; None for all."""

    translation_cm: float
    rotation_deg: float
    localized: int | None = None


@dataclass(frozen=True)
class BenchScene:
    """A measurement with its target, and the accuracy of COLMAP 4.2 with a map built from all references beforehand.

    Without a number of references, each photograph is localized from all others.
    """

    folder: str
    references: int | None
    target: Figures
    with_map: Figures


KITCHEN = "7scenes-redkitchen-seq01-first600"
SCENES = (
    BenchScene("fountain-P11", None, Figures(0.24, 0.020), Figures(0.22, 0.011)),
    BenchScene("herz-jesus-P8", None, Figures(0.45, 0.020), Figures(0.50, 0.021)),
    BenchScene(KITCHEN, 30, Figures(0.19, 0.065), Figures(0.18, 0.073)),
    BenchScene(KITCHEN, 10, Figures(0.45, 0.13), Figures(0.43, 0.127)),
    BenchScene(KITCHEN, 5, Figures(1.0, 0.23, 39), Figures(0.87, 0.208, 37)),
    BenchScene("tum-fr3-office", None, Figures(0.50, 0.21), Figures(0.51, 0.235)),
    BenchScene("kitti-drive-a", None, Figures(1.15, 0.035), Figures(1.00, 0.035)),
)
OTHER_FOLDERS = ("fox-portrait", "reichstag-internet", "rendered-room")
"""Without a target: two have an arbitrary unit, one is rendered."""


def met(target: Figures, summary: Summary) -> bool:
    """Whether a scene meets its target."""
    wanted = summary.query_count if target.localized is None else target.localized
    return (
        100 * summary.median_translation <= target.translation_cm
        and summary.median_rotation_deg <= target.rotation_deg
        and summary.localized_count >= wanted
    )
