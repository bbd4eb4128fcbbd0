"""Matches of a photograph that could not be posed alone.

Where the coarse stage finds no pose there is no structure either. But the references' tracks and poses are enough to
triangulate points, and the photograph's matches with the references lead to them through the tracks, without any pose
of the photograph. Too few to tell where it was taken, they may be enough together with those of other photographs.
"""

from __future__ import annotations

from dataclasses import replace

from ..match import vote
from ..observations import triangulate
from ..pipeline import Prepared
from ..results import Structure, Support
from ..structure import StructureOptions, observe, refine_points, tracks_of
from ..tracks import Tracks


def tracked_support(prepared: Prepared) -> Support | None:
    """What a pose of the photograph could rest on, found more widely; None where there is nothing."""
    query, references, check = prepared.query, prepared.references, prepared.context.check
    if len(references) < 2:
        return None
    known = prepared.correspondences.query_matches
    correspondences = prepared.pipeline.matcher.correspond(query, references, True, check, known)
    check()
    options = StructureOptions()
    tracks = tracks_of(references, correspondences, options)
    if not tracks.point_count:
        return None
    observations = observe(tracks, references, options.first_noise)
    refined = refine_points(observations, triangulate(observations), options)
    noise = replace(refined.noise, level_px=float(refined.noise.level_px))
    left = refined.observations.tracks
    assert isinstance(left, Tracks)
    structure = Structure(refined.x_in_world[refined.trusted], left.select(refined.trusted), noise)
    matches = vote(structure, [len(r.view.features) for r in references], correspondences)
    return Support(query, references, structure, matches, None, prepared.origin) if len(matches) else None
