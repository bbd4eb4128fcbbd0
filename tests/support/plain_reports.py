"""Reports of scenes as plainly as they are defined: from every stored count, one after another.

The twin of `store.reporting` and `scenes.report.summary`, which have the database add up.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import fields

import numpy as np
from sqlalchemy import select

from mapless_server.method.rejection import RejectionReason
from mapless_server.scenes.report.summary import HALF_LIFE_DAYS, LACKING_EVIDENCE, LEAST_RESCUED
from mapless_server.security import SceneKey
from mapless_server.store import Store
from mapless_server.store.counts import LOCALIZED, CountKey, Sums
from mapless_server.store.tables import scene_count

Counts = Mapping[CountKey, Sums]
NAMES = tuple(it.name for it in fields(Sums))


def stored_counts(store: Store, scene_key: SceneKey, first_day: int, last_day: int) -> dict[CountKey, Sums]:
    """Counts of a scene in some days, also of what is no answer."""
    column = scene_count.c
    found = select(scene_count).where(column.scene_id == scene_key, column.day.between(first_day, last_day))
    with store.database.read() as connection:
        return {
            CountKey(it.day, it.place_key, it.outcome): Sums(**{name: getattr(it, name) for name in NAMES})
            for it in connection.execute(found)
        }


def total(counts: Iterable[Sums]) -> Sums:
    found = Sums()
    for it in counts:
        found += it
    return found


def times(sums: Sums, weight: float) -> Sums:
    """The sums with each photograph counted as so many."""
    return Sums(**{name: weight * getattr(sums, name) for name in NAMES})


def plain_period(counts: Counts, first_day: int, last_day: int) -> tuple[dict[str, int], tuple[float, float, float]]:
    """Photographs of some days by outcome; means of their surveyed share, radius and inliers."""
    inside = {key: sums for key, sums in counts.items() if first_day <= key.day <= last_day}
    number = defaultdict[str, int](int)
    for key, sums in inside.items():
        number[key.outcome] += sums.photograph_count
    its = total(sums for key, sums in inside.items() if key.outcome == LOCALIZED)
    radius_m = math.exp(its.log_radius / its.radius_count) if its.radius_count else 0.0
    count = max(its.support_count, 1)
    return dict(number), (its.surveyed_share / count, radius_m, its.inlier_count / count)


def plain_places(counts: Counts, known: Iterable[str]) -> dict[str, dict[CountKey, Sums]]:
    """Counts by place, that with most rejected photographs first; empty where it is not known."""
    places, known = defaultdict[str, dict[CountKey, Sums]](dict), frozenset(known)
    for key, sums in counts.items():
        at = key if key.place_key in known else key._replace(place_key="")
        places[at.place_key][at] = places[at.place_key].get(at, Sums()) + sums
    return dict(sorted(places.items(), key=lambda it: (-plain_rejected(it[1]).photograph_count, it[0])))


def plain_rejected(counts: Counts) -> Sums:
    return total(sums for key, sums in counts.items() if key.outcome != LOCALIZED)


def plain_suggestions(
    places: Mapping[str, Counts], poses: Iterable[str], added: Mapping[str, int], last_day: int
) -> dict[str, tuple[float, int, int, RejectionReason, float]]:
    """Rescued, rejected and all photographs, commonest reason and distance, by place; without a limit of places."""
    found = {}
    for place in poses:
        counts = {it: sums for it, sums in places.get(place, {}).items() if it.day > added.get(place, -1)}
        aged = {it: times(sums, 2.0 ** (-(last_day - it.day) / HALF_LIFE_DAYS)) for it, sums in counts.items()}
        lacking = [it for it in counts if it.outcome in {reason.value for reason in LACKING_EVIDENCE}]
        if not lacking:
            continue
        rejected = total(aged[it] for it in lacking)
        rescued = rejected.photograph_count**2 / total(aged.values()).photograph_count
        of_reason = defaultdict[str, int](int)
        for it in lacking:
            of_reason[it.outcome] += counts[it].photograph_count
        offset = np.array([rejected.offset_x, rejected.offset_y, rejected.offset_z])
        found[place] = (
            rescued,
            sum(of_reason.values()),
            total(counts.values()).photograph_count,
            RejectionReason(max(of_reason, key=lambda it: (of_reason[it], it))),
            float(np.linalg.norm(offset / max(rejected.position_count, 1e-300))),
        )
    return {place: its for place, its in found.items() if its[0] >= LEAST_RESCUED}
