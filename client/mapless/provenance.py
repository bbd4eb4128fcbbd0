"""How the pose of a reference is known, as a value, a message and JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

import numpy as np

from . import names, wire
from .answers import Accuracy
from .v1 import reference_service_pb2 as pb
from .wire import FieldError, joined

GIVEN, PLACED, ADOPTED, UNKNOWN = "GIVEN", "PLACED", "ADOPTED", "UNSPECIFIED"
RADII = ("position_68_m", "position_95_m", "rotation_68_deg", "rotation_95_deg")
LARGEST_M, LARGEST_DEG = 1000.0, 180.0
"""Largest radii of a position and of a rotation."""
MOST_VOUCHERS = 64
"""Surveyed references that vouch for an adopted one."""
LEAST_EIGENVALUE = -1e-9
"""Rounding of the correlations of a covariance that is positive semi-definite."""
_SOURCE: wire.ProtoEnum = pb.PoseSource


@dataclass(frozen=True)
class Voucher:
    """A surveyed reference that the pose of an adopted one rests on: its id, and its matches that agree with it."""

    reference_id: str
    match_count: int

    def __post_init__(self) -> None:
        names.check_id(self.reference_id)
        if not 1 <= self.match_count < 2**31:
            raise ValueError(f"match_count must be at least 1, is {self.match_count}")


@dataclass(frozen=True)
class Provenance:
    """How the pose of a reference is known.

    Attributes:
        source: "GIVEN" by the caller who stored it, "PLACED" by mapless among the references that the scene had, or
            "ADOPTED" from a localized photograph; "UNSPECIFIED" where a server before 0.4 answers.
        accuracy: errors of the pose against the poses of the scene's other references, at most 1000 m and 180 degrees;
            None if unknown, which it is not for a reference that was placed or adopted.
        surveyed_share: of an adopted one, the share of what its answer explained that the survey explained alone,
            above 0, at most 1; else 0.
        vouchers: of an adopted one, the surveyed references that its pose rests on, at most 64; else empty.
        covariance: of the same errors as `accuracy`, which it requires: six rows of six, order x y z rx ry rz, metres
            (or the scene's unit) and radians about fixed axes of the scene's world, as of an answer; kept as
            tuples. Adjustments use it, where it is not None, in place of the radii.
        adopt_time: of an adopted one, when it was adopted, with time zone; None for the time of storing it. It is not
            compared: the same reference may be stored with it and without.
    """

    source: str = GIVEN
    accuracy: Accuracy | None = None
    surveyed_share: float = 0.0
    vouchers: tuple[Voucher, ...] = ()
    covariance: Sequence[Sequence[float]] | None = None
    adopt_time: datetime | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.adopt_time is not None and (self.source != ADOPTED or self.adopt_time.tzinfo is None):
            raise ValueError("adopt_time must have a time zone, and is only of an adopted pose")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", _checked(self.covariance))
            if self.accuracy is None:
                raise ValueError("accuracy is required where a covariance is given")
        if self.source in (PLACED, ADOPTED) and self.accuracy is None:
            raise ValueError(f"accuracy is required where the pose was {self.source.lower()}")
        if self.source == ADOPTED:
            if not 0 < self.surveyed_share <= 1:
                raise ValueError(f"surveyed_share must be above 0, at most 1, is {self.surveyed_share:g}")
            if not 1 <= len(self.vouchers) <= MOST_VOUCHERS:
                raise ValueError(f"vouchers must be 1 to {MOST_VOUCHERS}, are {len(self.vouchers)}")
        elif self.surveyed_share or self.vouchers:
            raise ValueError("surveyed_share and vouchers are only of an adopted pose")
        if self.accuracy is None:
            return
        least = 0.0
        for name in RADII:
            radius = getattr(self.accuracy, name)
            least = least if "_95_" in name else 0.0
            most = LARGEST_M if name.endswith("_m") else LARGEST_DEG
            if not least <= radius <= most:
                raise ValueError(f"accuracy.{name} must be {least:g} to {most:g}, is {radius:g}")
            least = radius


def _checked(covariance: object) -> tuple[tuple[float, ...], ...]:
    """The rows of a covariance; ValueError if it is none, or of errors that are too large."""
    try:
        values = np.asarray(covariance, float)
    except ValueError:  # rows of several lengths
        values = np.empty(0)
    if values.shape != (6, 6) or not np.isfinite(values).all():
        raise ValueError("covariance must be 6x6 finite numbers")
    deviations = np.sqrt(np.diag(values).clip(min=0))
    unit = np.where(deviations > 0, deviations, 1.0)  # metres and radians differ by orders of magnitude
    correlations = values / np.outer(unit, unit)
    is_symmetric = np.abs(correlations - correlations.T).max() <= 1e-6
    if not is_symmetric or np.linalg.eigvalsh(correlations).min() < LEAST_EIGENVALUE:
        raise ValueError("covariance must be symmetric and positive semi-definite")
    if deviations[:3].max() > LARGEST_M or np.degrees(deviations[3:].max()) > LARGEST_DEG:
        raise ValueError(f"covariance must have standard deviations of at most {LARGEST_M:g} m and {LARGEST_DEG:g} deg")
    return tuple(tuple(row) for row in values.tolist())


GIVEN_POSE = Provenance()
"""A given pose of unknown accuracy."""


def provenance_to_message(provenance: Provenance) -> pb.Provenance:
    """Message of a provenance, with the radii of its accuracy.

    TypeError for another type; ValueError if its source is unknown.
    """
    wire.require(provenance, Provenance, "provenance")
    message = pb.Provenance(
        source=wire.enum_value(_SOURCE, "" if provenance.source == UNKNOWN else provenance.source),
        surveyed_share=provenance.surveyed_share,
        vouchers=[pb.Voucher(reference_id=it.reference_id, match_count=it.match_count) for it in provenance.vouchers],
    )
    if provenance.accuracy is not None:
        wire.set_numbers(message.accuracy, {it: getattr(provenance.accuracy, it) for it in RADII}, "accuracy")
    if provenance.covariance is not None:
        message.covariance.row_major.extend(np.ravel(provenance.covariance).tolist())
    if provenance.adopt_time is not None:
        wire.set_time(message.adopt_time, provenance.adopt_time, "adopt_time")
    return message


def provenance_from_message(message: pb.Provenance, field: str) -> Provenance:
    """Provenance of a message; an unknown source, from a newer program, is its number as text.

    FieldError if a radius is out of range, or what a placed or adopted pose requires is missing.
    """
    accuracy = _radii([getattr(message.accuracy, it) for it in RADII]) if message.HasField("accuracy") else None
    try:
        vouchers = tuple(Voucher(it.reference_id, it.match_count) for it in message.vouchers)
    except ValueError as error:
        raise FieldError(joined(field, "vouchers"), str(error)) from None
    covariance = _rows(message.covariance.row_major) if message.HasField("covariance") else None
    try:
        source = wire.value_name(_SOURCE.DESCRIPTOR, message.source)
        adopted = message.adopt_time.ToDatetime(timezone.utc) if message.HasField("adopt_time") else None
        return Provenance(source, accuracy, message.surveyed_share, vouchers, covariance, adopted)
    except ValueError as error:
        name, _, fault = str(error).partition(" ")
        raise FieldError(joined(field, name), fault) from None


def provenance_to_json(provenance: Provenance) -> dict[str, Any] | None:
    """Provenance as JSON: `source` in small letters, radii, rows of the covariance.

    None for `GIVEN_POSE` or an unknown source.
    """
    if provenance == GIVEN_POSE or provenance.source not in (GIVEN, PLACED, ADOPTED):
        return None
    accuracy = provenance.accuracy
    content: dict[str, Any] = {"source": provenance.source.lower()}
    content |= {} if accuracy is None else {it: getattr(accuracy, it) for it in RADII}
    if provenance.covariance is not None:
        content["covariance"] = [list(row) for row in provenance.covariance]
    if provenance.source == ADOPTED:
        content["surveyed_share"] = provenance.surveyed_share
        content["vouchers"] = {it.reference_id: it.match_count for it in provenance.vouchers}
        content |= {} if provenance.adopt_time is None else {"adopt_time": provenance.adopt_time.isoformat()}
    return content


def provenance_from_json(content: object) -> Provenance:
    """The provenance that `provenance_to_json` was given; ValueError names the wrong field."""
    if content is None:
        return GIVEN_POSE
    if not isinstance(content, Mapping):
        raise ValueError("must be an object")
    sources = [it.lower() for it in (GIVEN, PLACED, ADOPTED)]
    if content.get("source") not in sources:
        raise ValueError(f"source must be {', '.join(sources[:-1])} or {sources[-1]}, is {content.get('source')!r}")
    source = str(content["source"]).upper()
    if not any(it in content for it in RADII):
        return Provenance(source)
    accuracy = _radii([_number(content, it) for it in RADII])
    covariance = _rows_of_json(content.get("covariance"))
    if source != ADOPTED:
        return Provenance(source, accuracy, covariance=covariance)
    vouchers = content.get("vouchers")
    if not isinstance(vouchers, Mapping) or not all(isinstance(it, int) for it in vouchers.values()):
        raise ValueError("vouchers must be an object with numbers of matches")
    vouching = tuple(Voucher(str(name), count) for name, count in vouchers.items())
    share, adopted = _number(content, "surveyed_share"), _time(content.get("adopt_time"))
    return Provenance(source, accuracy, share, vouching, covariance, adopted)


def _time(content: object) -> datetime | None:
    if content is None:
        return None
    try:
        return datetime.fromisoformat(str(content))
    except ValueError:
        raise ValueError(f"adopt_time must be a time such as 2026-11-29T18:00:00+00:00, is {content!r}") from None


def _rows(row_major: Sequence[float]) -> tuple[tuple[float, ...], ...]:
    """Rows of six; the last is shorter where there are not 36 numbers, which `Provenance` refuses."""
    return tuple(tuple(row_major[i : i + 6]) for i in range(0, len(row_major), 6))


def _rows_of_json(content: object) -> tuple[tuple[float, ...], ...] | None:
    if content is None:
        return None
    fault = "covariance must be six lists of six numbers"
    if not isinstance(content, list) or not all(isinstance(it, list) for it in content):
        raise ValueError(fault)
    if any(isinstance(it, bool) or not isinstance(it, int | float) for row in content for it in row):
        raise ValueError(fault)
    return tuple(tuple(float(it) for it in row) for row in content)


def _number(content: Mapping[Any, object], name: str) -> float:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} must be a number, is {value!r}")
    return float(value)


def _radii(values: Sequence[float]) -> Accuracy:
    """Accuracy with these values of `RADII`."""
    position_68_m, position_95_m, rotation_68_deg, rotation_95_deg = values
    return Accuracy(position_68_m, position_95_m, rotation_68_deg, rotation_95_deg)
