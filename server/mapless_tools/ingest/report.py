"""The report of an import, for people and for programs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from rich.console import Console

from mapless import PendingWork
from mapless.results import summary_of
from mapless_server.method.pairs.readings.alignment import Alignment
from mapless_server.method.pairs.readings.verdict import Verdict
from mapless_server.scenes.repeats import same_pose_text
from mapless_tools.dataset import Dataset, Frame, Refusal
from mapless_tools.output_files import finite

from .check import SceneVerdict

WRONG_POSES = "nothing is stored while the poses do not fit the photographs; --skip-check stores them all the same"
SAME_POSE = "has exactly the same pose as {count} others that show different things; --skip-check stores it"
WRONG_WORLD = (
    "nothing is stored while the photographs do not fit the scene's references; --align-to-scene aligns them, "
    "--skip-check stores them all the same"
)
SHOWN = 20
ALREADY_THERE = "already there"


@dataclass
class ImportReport:
    """Counts and reasons; refused frames are named as in their file, skipped ones by id.

    Of the chosen frames, `added` are the ids of stored references, `blank` those without local features, with which
    nothing can be matched; skipped ones exist already. Warnings are contradictions of poses, datum, direction of
    gravity and unit. `stopped` says why the import ended before its end, `is_server_gone` whether because the server
    did not answer, `pending` what it has still to make in the background. The verdict is None if there was no epipolar
    check, that with the scene's references if there were none.
    """

    scene: str
    dataset: Dataset
    chosen: Sequence[Frame]
    verdict: Verdict | None = None
    scene_verdict: SceneVerdict | None = None
    warnings: list[str] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    blank: list[str] = field(default_factory=list)
    skipped: list[Refusal] = field(default_factory=list)
    refused: list[Refusal] = field(default_factory=list)
    stopped: str = ""
    is_server_gone: bool = False
    seconds: float = 0.0
    pending: Sequence[PendingWork] = ()
    is_dry: bool = False

    def __post_init__(self) -> None:
        self.refused += self.dataset.refused

    @property
    def untried_count(self) -> int:
        """Number of frames that the import did not reach."""
        tried = len(self.added) + len(self.skipped) + len(self.refused) - len(self.dataset.refused)
        return 0 if self.is_dry else len(self.chosen) - tried

    @property
    def went_well(self) -> bool:
        """Whether everything was imported; for a dry run, whether everything could be."""
        wrong = self.verdict is not None and self.verdict.is_wrong
        return not (self.refused or self.stopped or self.untried_count or (self.is_dry and wrong))


def verdict_lines(verdict: Verdict, frames: Sequence[Frame]) -> list[str]:
    """The result of the epipolar check, a sentence per line."""
    lines: list[str] = []
    for group in verdict.same_pose:
        names = [frames[i].name for i in group]
        text = same_pose_text("that show different things", names, frames[group[0]].world_from_camera)
        lines.append(f"warning: {text}")
    lines += [
        f"warning: {frames[i].name} and {frames[j].name} are the same photograph, with poses that differ"
        for i, j in verdict.same_photograph
    ]
    if not verdict.is_known:
        return [
            "warning: the poses could not be checked: none of the photographs that were compared have enough matches",
            *lines,
        ]
    compared = {index for error in verdict.pairs for index in error.pair}
    errors = (
        f"epipolar error of matched points under the given poses: median {verdict.median_px:.2f} px over "
        f"{len(verdict.pairs)} pairs of neighbours among {len(compared)} of {len(frames)} photographs, "
        f"{100 * verdict.bad_share:.0f} % of them above {verdict.threshold_px:.1f} px"
    )
    lines.insert(0, errors)
    if verdict.is_wrong:
        lines.append("warning: axes, intrinsics or poses are wrong: photographs of neighbours do not fit together")
        if verdict.explanation:
            then = f"; the error would then be {verdict.explained_px:.2f} px" if verdict.explained_px >= 0 else ""
            lines.append(f"warning: most likely {verdict.explanation}{then}")
        else:
            lines.append("warning: none of the usual mistakes explains it")
    lines += [
        f"warning: {frames[index].name} does not fit its neighbours: its pose or its image is wrong"
        for index in verdict.suspects
    ]
    if verdict.unmatched_count > len(verdict.pairs):
        lines.append(
            f"warning: {verdict.unmatched_count} further pairs have too few matches: are positions and headings right?"
        )
    return lines


def not_aligned(found: Alignment | None) -> str:
    """Why frames cannot be aligned to a scene."""
    if found is None:
        return "--align-to-scene: too few photographs match those of the scene, or no similarity fits most of them"
    return (
        f"--align-to-scene: the matches do not determine one similarity: {100 * found.bad_share:.0f} % of "
        f"{found.pair_count} pairs do not fit, the scale is known to {100 * found.scale_sigma:.2g} %, the rotation to "
        f"{math.degrees(found.rotation_sigma):.2g} degrees, the position to {100 * found.position_sigma:.2g} % of the "
        "extent"
    )


def print_report(report: ImportReport, console: Console) -> None:
    """Prints the report, with at most SHOWN reasons of a kind."""
    _print_reasons("refused", report.refused, console)
    if report.is_dry and report.verdict is not None and report.verdict.is_wrong:
        console.print(WRONG_POSES, markup=False, highlight=False)
        return
    if report.is_dry:
        good = len(report.chosen) - (len(report.refused) - len(report.dataset.refused))
        summary = f"{good} references could be imported, {len(report.refused)} are refused"
        console.print(summary, markup=False, highlight=False)
        return
    nothing = "no local features: nothing can be matched with it"
    _print_reasons("warning, blank, dark or blurred", [Refusal(it, nothing) for it in report.blank], console)
    _print_reasons("skipped as duplicates", [it for it in report.skipped if it.reason != ALREADY_THERE], console)
    rate = f" ({len(report.added) / report.seconds:.1f} a second)" if report.added and report.seconds > 0 else ""
    counts = [f"{len(report.added)} added{rate}", f"{len(report.skipped)} skipped as duplicates"]
    counts.append(f"{len(report.refused)} refused")
    if report.untried_count:
        counts.append(f"{report.untried_count} not reached")
    console.print(f"scene {report.scene}: {', '.join(counts)}", markup=False, highlight=False)
    if left := summary_of(report.pending):
        console.print(f"left to the server's background: {left}", markup=False, highlight=False)
    if report.stopped:
        console.print(f"stopped: {report.stopped}", markup=False, highlight=False)
        if report.added:
            console.print("what is in stays in; the same command goes on from there", markup=False)
        elif report.is_server_gone:
            console.print("nothing is lost: the same command goes on once the server answers", markup=False)


def to_json(report: ImportReport) -> dict[str, Any]:
    """The whole report as JSON values."""
    verdict = report.verdict
    return {
        "scene": report.scene,
        "format": report.dataset.format,
        "source": report.dataset.source,
        "ground_truth": report.dataset.ground_truth,
        "notes": list(report.dataset.notes),
        "metric": report.dataset.metric,
        "warnings": list(report.warnings),
        "dry_run": report.is_dry,
        "chosen": len(report.chosen),
        "added": list(report.added),
        "blank": list(report.blank),
        "skipped": [vars(item) for item in report.skipped],
        "refused": [vars(item) for item in report.refused],
        "not_reached": report.untried_count,
        "stopped": report.stopped,
        "seconds": report.seconds,
        "pending_work": [vars(it) for it in report.pending],
        "scene_check": None if report.scene_verdict is None else _scene_verdict_json(report.scene_verdict),
        "check": None if verdict is None else _verdict_json(verdict, report.chosen),
    }


def _scene_verdict_json(verdict: SceneVerdict) -> dict[str, Any]:
    found = verdict.alignment
    return {
        "fitting": list(verdict.fitting),
        "misfits": list(verdict.misfits),
        "wrong": verdict.is_wrong,
        "alignment": None
        if found is None
        else {
            "unique": found.is_unique,
            "scale": found.world_from_other.scale,
            "rotation": found.world_from_other.rotation.tolist(),
            "translation": found.world_from_other.translation.tolist(),
            "text": found.text,
            "median_px": finite(found.median_px),
        },
    }


def _verdict_json(verdict: Verdict, frames: Sequence[Frame]) -> dict[str, Any]:
    return {
        "median_px": finite(verdict.median_px),
        "bad_share": finite(verdict.bad_share),
        "threshold_px": verdict.threshold_px,
        "median_depth": verdict.median_depth,
        "pairs_without_matches": verdict.unmatched_count,
        "wrong": verdict.is_wrong,
        "explanation": verdict.explanation,
        "explained_px": finite(verdict.explained_px),
        "suspects": [frames[i].name for i in verdict.suspects],
        "same_pose": [[frames[i].name for i in group] for group in verdict.same_pose],
        "same_photograph": [[frames[i].name for i in pair] for pair in verdict.same_photograph],
        "pairs": [
            {
                "references": [frames[i].name for i in pair.pair],
                "error_px": pair.error_px,
                "matches": pair.match_count,
                "bad": pair.is_bad,
            }
            for pair in verdict.pairs
        ],
    }


def _print_reasons(title: str, items: Sequence[Refusal], console: Console) -> None:
    if not items:
        return
    lines = [f"{title}:", *(f"  {item.frame}: {item.reason}" for item in items[:SHOWN])]
    console.print("\n".join(lines), markup=False, highlight=False)
    if len(items) > SHOWN:
        console.print(f"... and {len(items) - SHOWN} more; --report writes them all")
