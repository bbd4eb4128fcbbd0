"""Answers as JSON, and as text for a terminal."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import re
import sys
from collections.abc import Sequence
from datetime import datetime
from enum import Enum
from typing import Any

import numpy as np
from google.protobuf import json_format
from google.protobuf.message import Message

from .. import wire
from ..answers import Accuracy, IntrinsicsCheck, LocalizationResult, PriorCheck, Rejected
from ..geometry import Camera, RigidTransform

DOUBTFUL_TRUST = 0.15
"""Below it, an answer looks worse than 17 of 20 right ones of difficult places: the intrinsics may be wrong."""

_FIELDS = {
    "FOCAL_LENGTH": "focal_x_px",
    "PRINCIPAL_X": "principal_x_px",
    "PRINCIPAL_Y": "principal_y_px",
    "K1": "k1",
}
"""Of CameraIntrinsics, as rejections name them, by parameter."""
_NUMBER = re.compile(r"-?[\d.]+")
_CAPTURED = "captured by the server"


def is_json(arguments: argparse.Namespace) -> bool:
    """Whether to print JSON: not on a terminal, unless --json or --text decides."""
    return bool(arguments.json if arguments.json is not None else not sys.stdout.isatty())


def show(arguments: argparse.Namespace, value: object, text: Sequence[str]) -> int:
    """Prints a value as JSON or as its text, see `is_json`; returns exit code 0."""
    print(json.dumps(plain(value), indent=2) if is_json(arguments) else "\n".join(text), flush=True)
    return 0


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Lines of a table: a heading and rows, with numbers aligned to the right."""
    columns = [[name, *map(str, cells)] for name, *cells in zip(head, *rows, strict=True)]
    for column in columns:
        is_number = len(column) > 1 and all(map(_NUMBER.fullmatch, column[1:]))
        width = max(map(len, column))
        column[:] = [cell.rjust(width) if is_number else cell.ljust(width) for cell in column]
    return ["  ".join(cells).rstrip() for cells in zip(*columns, strict=True)]


def card(**fields: object) -> list[str]:
    """Lines with a name and a value each; omits fields that are None."""
    known = {name: value for name, value in fields.items() if value is not None}
    width = max(map(len, known), default=0)
    return [f"{name:{width}}  {value}" for name, value in known.items()]


def plain(value: Any) -> Any:
    """A result as JSON values, with geometry in the form that --camera and --pose read."""
    if isinstance(value, Camera):
        return plain(wire.camera_to_message(value))
    if isinstance(value, RigidTransform):
        return plain(wire.transform_to_message(value))
    if isinstance(value, Message):
        # Zeros too, which protobuf's JSON leaves out: a program that reads translation_m.x finds it wherever the
        # camera is. What can be absent, such as a lens, stays absent.
        return json_format.MessageToDict(
            value, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
        )
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has neither NaN nor infinity
    return value


def lines(answer: LocalizationResult | Rejected) -> list[str]:
    """An answer as a few lines."""
    if isinstance(answer, Rejected):
        text = [f"not localized: {answer.reason}", f"  {answer.message}"]
        if answer.hint is not None and answer.hint.message:
            text.append(f"  {answer.hint.message}")
        if answer.hint is not None and answer.hint.best_reference:
            text.append(f"  shares most with reference {answer.hint.best_reference.rpartition('/')[2]}")
        return [*text, f"  {_CAPTURED}"] if answer.diagnostics.captured else text
    pose = answer.world_from_camera if answer.in_axes is None else answer.in_axes.world_from_camera
    frame = "" if answer.in_axes is None else f"   in {answer.in_axes.axes} axes"
    x, y, z = pose.translation
    q = pose.quaternion()
    unit = "units" if answer.arbitrary_unit else "m"
    text = [
        f"{_outcome(answer)}{frame}",
        f"  position  {x:.3f}  {y:.3f}  {z:.3f} {unit}{_radius(answer.accuracy, 'position', unit)}",
        f"  rotation  x {q.x:.4f}  y {q.y:.4f}  z {q.z:.4f}  w {q.w:.4f}{_radius(answer.accuracy, 'rotation', 'deg')}",
    ]
    if answer.geo_pose is not None:
        geo = answer.geo_pose
        text.append(f"  on earth  {geo.lat:.7f}, {geo.lon:.7f}, {geo.h:.2f} m")
    text += [f"  prior     {_checked(check)}" for check in answer.prior_checks]
    text += [f"  camera    {_corrected(check)}" for check in answer.intrinsics_checks if _differs(check)]
    captured = f", {_CAPTURED}" if answer.diagnostics.captured else ""
    tracked = ", tracked" if answer.diagnostics.is_tracked else ""
    text.append(f"  support   {_support(answer)}, {answer.diagnostics.total_s:.2f} s{tracked}{captured}")
    if answer.arbitrary_unit:
        text.append("  warning   the scene's unit of length is arbitrary, not the metre")
    if answer.scale_source == "NETWORK":
        text.append("  warning   a single reference: its distance is a network's estimate, as the radius says")
    if answer.trust is not None and answer.trust < DOUBTFUL_TRUST:
        text.append(
            f"  warning   fewer than {100 * DOUBTFUL_TRUST:g} % of right answers look as doubtful: check the intrinsics"
        )
    return text


def line(name: str, answer: LocalizationResult | Rejected) -> str:
    """An answer as one row of a table."""
    if isinstance(answer, Rejected):
        return f"{name}  not localized: {answer.reason}"
    x, y, z = answer.world_from_camera.translation
    unit, radius = "units" if answer.arbitrary_unit else "m", " " * 11
    if answer.accuracy is not None:
        radius_m = answer.accuracy.position_95_m
        radius = f"{radius_m:11.4g}" if answer.arbitrary_unit else f"{100 * radius_m:8.2f} cm"
    trust = f"{answer.trust:6.3f}" if answer.trust is not None else " " * 6
    counts = f"{answer.inlier_count}/{answer.match_count}"
    return f"{name}  {x:9.3f} {y:9.3f} {z:9.3f} {unit} {radius} {trust}  {counts:>9}"


def heading(width: int) -> str:
    """Heading of the table of `line`, for names of this width."""
    return f"{'photograph':{width}}  {'x':>9} {'y':>9} {'z':>9}    {'95 % within':>10} {'trust':>6}  {'inliers':>9}"


def _outcome(answer: LocalizationResult) -> str:
    if answer.pose_stage == "COARSE":
        return "coarse pose" if answer.is_final else "coarse pose, the refined one follows"
    return "localized" if answer.trust is None else f"localized, trust {answer.trust:.3f}"


def _support(answer: LocalizationResult) -> str:
    """Text of a pose's inliers and references."""
    if answer.pose_stage == "COARSE":
        return "not verified"
    used = sum(use.inlier_count > 0 for use in answer.diagnostics.references)
    return f"{answer.inlier_count} of {answer.match_count} matches, {used} references"


def _checked(check: PriorCheck) -> str:
    """Text of how an answer compares with a prior."""
    if check.conflict:
        ignored = "" if check.used else ", not used"
        return f"{check.kind} contradicts the photograph: {check.mahalanobis:.1f} standard deviations{ignored}"
    return f"{check.kind} agrees, " + ("used" if check.used else "less certain than the photograph, not needed")


def _differs(check: IntrinsicsCheck) -> bool:
    """Whether the photograph's value was used because it differs from the given one by more than its usual error."""
    return check.used and abs(check.estimated - check.given) > check.given_sigma


def _corrected(check: IntrinsicsCheck) -> str:
    """Text of how a parameter of the camera differs from the photograph's estimate."""
    name = _FIELDS.get(check.parameter, check.parameter)
    digits = 3 if check.parameter == "K1" else 1
    return (
        f"{name} is {check.given:.{digits}f}, the photograph says {check.estimated:.{digits}f} +- "
        f"{check.estimated_sigma:.{digits}f}: used"
    )


def _radius(accuracy: Accuracy | None, kind: str, unit: str) -> str:
    if accuracy is None:
        return ""
    factor, shown = (100, "cm") if unit == "m" else (1, unit)
    suffix = "m" if kind == "position" else "deg"
    radii = [factor * getattr(accuracy, f"{kind}_{share}_{suffix}") for share in (68, 95)]
    note = f"calibrated {accuracy.calibrated_by}" if accuracy.calibrated_by else "uncalibrated"
    return f"   within {radii[0]:.2g} {shown} (68 %), {radii[1]:.2g} {shown} (95 %, {note})"
