"""How the pose of a reference is known, as a value, a message and JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from . import wire
from .answers import Accuracy
from .v1 import reference_service_pb2 as pb
from .wire import FieldError, joined

GIVEN, PLACED, UNKNOWN = "GIVEN", "PLACED", "UNSPECIFIED"
RADII = ("position_68_m", "position_95_m", "rotation_68_deg", "rotation_95_deg")
LARGEST_M, LARGEST_DEG = 1000.0, 180.0
"""Largest radii of a position and of a rotation."""
_SOURCE: wire.ProtoEnum = pb.PoseSource


@dataclass(frozen=True)
class Provenance:
    """How the pose of a reference is known.

    Attributes:
        source: "GIVEN" by the caller who stored it, or "PLACED" by mapless among the references that the scene had;
            "UNSPECIFIED" where a server before 0.4 answers.
        accuracy: errors of the pose against the poses of the scene's other references, at most 1000 m and 180 degrees;
            None if unknown, which it is not for a reference that was placed.
    """

    source: str = GIVEN
    accuracy: Accuracy | None = None

    def __post_init__(self) -> None:
        if self.source == PLACED and self.accuracy is None:
            raise ValueError("accuracy is required where the pose was placed")
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


GIVEN_POSE = Provenance()
"""A given pose of unknown accuracy."""


def provenance_to_message(provenance: Provenance) -> pb.Provenance:
    """Message of a provenance, with the radii of its accuracy.

    TypeError for another type; ValueError if its source is unknown.
    """
    wire.require(provenance, Provenance, "provenance")
    message = pb.Provenance(source=wire.enum_value(_SOURCE, "" if provenance.source == UNKNOWN else provenance.source))
    if provenance.accuracy is not None:
        wire.set_numbers(message.accuracy, {it: getattr(provenance.accuracy, it) for it in RADII}, "accuracy")
    return message


def provenance_from_message(message: pb.Provenance, field: str) -> Provenance:
    """Provenance of a message; an unknown source, from a newer program, is its number as text.

    FieldError if a radius is out of range, or the accuracy of a placed pose is missing.
    """
    accuracy = _radii([getattr(message.accuracy, it) for it in RADII]) if message.HasField("accuracy") else None
    try:
        return Provenance(wire.value_name(_SOURCE.DESCRIPTOR, message.source), accuracy)
    except ValueError as error:
        name, _, fault = str(error).partition(" ")
        raise FieldError(joined(field, name), fault) from None


def provenance_to_json(provenance: Provenance) -> dict[str, Any] | None:
    """Provenance as JSON: `source` in small letters, and the radii; None for `GIVEN_POSE` or an unknown source."""
    if provenance == GIVEN_POSE or provenance.source not in (GIVEN, PLACED):
        return None
    accuracy = provenance.accuracy
    radii = {} if accuracy is None else {it: getattr(accuracy, it) for it in RADII}
    return {"source": provenance.source.lower(), **radii}


def provenance_from_json(content: object) -> Provenance:
    """The provenance that `provenance_to_json` was given; ValueError names the wrong field."""
    if content is None:
        return GIVEN_POSE
    if not isinstance(content, Mapping):
        raise ValueError("must be an object")
    sources = [it.lower() for it in (GIVEN, PLACED)]
    if content.get("source") not in sources:
        raise ValueError(f"source must be {' or '.join(sources)}, is {content.get('source')!r}")
    source = str(content["source"]).upper()
    if not any(it in content for it in RADII):
        return Provenance(source)
    radii = []
    for name in RADII:
        radius = content.get(name)
        if isinstance(radius, bool) or not isinstance(radius, int | float):
            raise ValueError(f"{name} must be a number, is {radius!r}")
        radii.append(float(radius))
    return Provenance(source, _radii(radii))


def _radii(values: Sequence[float]) -> Accuracy:
    """Accuracy with these values of `RADII`."""
    position_68_m, position_95_m, rotation_68_deg, rotation_95_deg = values
    return Accuracy(position_68_m, position_95_m, rotation_68_deg, rotation_95_deg)
