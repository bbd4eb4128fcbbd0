"""Tags of known size: which of them can be trusted, by the squares that photographs agree on, and their scale."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mapless_tools.progress import Progress

from ..pictures import Part, PosedPicture
from .options import SizedTag, TagId
from .scales import ScaleEstimate
from .sightings import Sighting, sightings
from .squares import MIN_PHOTOGRAPHS, Square, squares

MAX_EDGE_SIGMA = 0.05
"""Largest relative standard deviation of an edge that gives a unit: beyond, photographs are too near to each other."""
MAX_DEFORMATION = 0.03
"""Largest root mean square of a tag's corners from a square, as a share of its edge: sheets of paper are bent by 1 or
2 %, what is no tag is no square."""
CORNER_SIGMA_PX = 0.2
"""How far each side of a black square may appear inside its true line where white is overexposed: 0.05 to 0.3 pixels in
the rendered room; alike in all photographs, so that no number of them averages it out."""
SIZE_SIGMA_M = 0.0005
"""Standard deviation of a length that was read on a ruler."""
_MAX_NAMED = 3


@dataclass(frozen=True, eq=False)
class TagPlace:
    """A tag at a place that its photographs agree on, and the unit of length that follows from its size."""

    sized: SizedTag
    square: Square
    estimate: ScaleEstimate


@dataclass(frozen=True)
class FoundTags:
    """The places of tags that can be trusted, and what is to be said of the others."""

    places: tuple[TagPlace, ...]
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def only_place(self, tag: TagId) -> TagPlace | None:
        """The place of a tag, None if it has none; ValueError if it has several."""
        places = [it for it in self.places if it.sized.tag == tag]
        if len(places) > 1:
            raise ValueError(f"origin: tag {tag} is at {len(places)} places; name a tag that is at one")
        return places[0] if places else None


def find_tags(part: Part, tags: Sequence[SizedTag], progress: Progress) -> FoundTags:
    """Finds tags in the photographs, and judges them by their geometry."""
    seen = sightings(part.posed, [it.tag.family for it in tags], progress)
    found = [_judged(part.posed, it, seen.get(it.tag, ())) for it in tags]
    warnings = [text for it in found for text in it.warnings]
    if warnings:
        warnings += _others(seen, tags)
    return FoundTags(
        tuple(place for it in found for place in it.places),
        tuple(text for it in found for text in it.notes),
        tuple(warnings),
    )


def _judged(posed: Sequence[PosedPicture], sized: SizedTag, seen: Sequence[Sighting]) -> FoundTags:
    photographs = {it.photograph for it in seen}
    if len(photographs) < MIN_PHOTOGRAPHS:
        where = f" ({_names(posed, seen)})" if seen else ""
        warning = f"tag {sized.tag} is in {len(photographs)} of {len(posed)} photographs{where}: it gives no unit"
        return FoundTags((), warnings=(f"{warning}, {MIN_PHOTOGRAPHS} are needed",))
    found, rest = squares(posed, seen)
    if not found:
        count = len(photographs)
        text = f"tag {sized.tag}: no {MIN_PHOTOGRAPHS} of its {count} photographs agree on its place"
        return FoundTags((), warnings=(f"{text}: false detections, a tag that moves, or photographs from one place",))
    warnings = [text for square in found if (text := _fault(sized, square))]
    places = [_place(sized, square) for square in found if not _fault(sized, square)]
    if len(found) > 1:
        warnings.append(_several(posed, sized, found, seen))
    if rest:
        count = len(rest)
        warnings.append(f"tag {sized.tag}: {count} detections are of something else ({_names(posed, rest)})")
    return FoundTags(tuple(places), tuple(map(_note, places)), tuple(warnings))


def _fault(sized: SizedTag, square: Square) -> str:
    """Why a square gives no unit, empty if it does."""
    count = len(square.photographs)
    if square.edge_sigma > MAX_EDGE_SIGMA:
        return (
            f"tag {sized.tag}: the length of its edge is uncertain by {100 * square.edge_sigma:.0f} % in {count} "
            f"photographs (at most {100 * MAX_EDGE_SIGMA:.0f} %): they are too near to each other, or badly posed"
        )
    if square.deformation > MAX_DEFORMATION:
        return (
            f"tag {sized.tag}: its corners in {count} photographs are no square, by {100 * square.deformation:.0f} % "
            f"of its edge (at most {100 * MAX_DEFORMATION:.0f} %): a false detection, or a bent sheet"
        )
    return ""


def _place(sized: SizedTag, square: Square) -> TagPlace:
    # Both ends of an edge may appear displaced.
    by_corners = math.sqrt(2) * CORNER_SIGMA_PX / square.edge_px
    sigma = math.hypot(square.edge_sigma, by_corners, SIZE_SIGMA_M / sized.edge_m)
    scale = sized.edge_m / square.part_from_tag.scale
    return TagPlace(sized, square, ScaleEstimate(f"tag {sized.tag}", scale, sigma))


def _note(place: TagPlace) -> str:
    square = place.square
    return (
        f"tag {place.sized.tag} of {place.sized.edge_m:g} m is in {len(square.photographs)} photographs that agree: "
        f"its edges to {100 * square.edge_sigma:.2g} %, its corners to a square to {100 * square.deformation:.2g} %"
    )


def _several(posed: Sequence[PosedPicture], sized: SizedTag, found: Sequence[Square], seen: Sequence[Sighting]) -> str:
    photographs = [it.photograph for it in seen]
    both = [i for i in dict.fromkeys(photographs) if photographs.count(i) > 1 and i in found[0].photographs]
    how = f"twice in {_named(posed, both)}" if both else "in the scene twice, or was moved"
    edges = ", ".join(f"{it.part_from_tag.scale / found[0].part_from_tag.scale:.3f}" for it in found[1:])
    return (
        f"tag {sized.tag} is at {len(found)} places, {how}: the first is in {len(found[0].photographs)} photographs; "
        f"edges of the others are {edges} times that of the first"
    )


def _others(seen: Mapping[TagId, Sequence[Sighting]], tags: Sequence[SizedTag]) -> list[str]:
    """Names tags that are often seen, but were not given."""
    given = {it.tag for it in tags}
    counts = {tag: len({it.photograph for it in all_of}) for tag, all_of in seen.items() if tag not in given}
    often = sorted((-count, tag) for tag, count in counts.items() if count >= MIN_PHOTOGRAPHS)[:_MAX_NAMED]
    named = [f"{tag} in {-count}" for count, tag in often]
    return [f"photographs show tags that were not given: {', '.join(named)} photographs"] if named else []


def _names(posed: Sequence[PosedPicture], seen: Sequence[Sighting]) -> str:
    return _named(posed, [it.photograph for it in seen])


def _named(posed: Sequence[PosedPicture], photographs: Sequence[int]) -> str:
    names = [posed[i].picture.name for i in dict.fromkeys(photographs)]
    return ", ".join(names[:_MAX_NAMED]) + (f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else "")
