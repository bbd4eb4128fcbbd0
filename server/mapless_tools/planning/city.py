"""Who asks where: scenes and their places, some more popular than others, and people who stay or walk on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .figures import REFERENCES_PER_QUERY

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class City:
    """A city of scenes, a scene of places; a query needs all references of the place where it is asked.

    Attributes:
        scenes: a street or a square each, of a thousand references: ranked in less than a millisecond, and fine enough
            to be divided among devices.
        places: of each scene; neighbours in number are neighbours in the street.
        references_per_place: what one query is compared with.
        queries_per_s: of all users together.
        scene_exponent: of Zipf's law between scenes: the station is asked for more than a side street. Near 1 is what
            visits to places, pages and films were found to follow; how it is in a city of ours nobody knows.
        place_exponent: likewise within a scene, flatter.
        session_queries: how many queries a user asks on average, before another one begins elsewhere.
        walking: share of queries after which the user has come to a neighbouring place.
        users: at once.
    """

    scenes: int = 10_000
    places: int = 100
    references_per_place: int = REFERENCES_PER_QUERY
    queries_per_s: float = 1000.0
    scene_exponent: float = 0.9
    place_exponent: float = 0.6
    session_queries: float = 20.0
    walking: float = 0.2
    users: int = 1000

    def __post_init__(self) -> None:
        if min(self.scenes, self.places, self.references_per_place, self.users) < 1:
            raise ValueError("counts must be at least 1")
        if not (self.queries_per_s > 0 and self.session_queries >= 1 and 0 <= self.walking <= 1):
            raise ValueError("queries_per_s must be above 0, session_queries at least 1, walking from 0 to 1")
        if not min(self.scene_exponent, self.place_exponent) >= 0:
            raise ValueError("exponents must be at least 0")

    @property
    def reference_count(self) -> int:
        """All references."""
        return self.scenes * self.places * self.references_per_place

    def scene_shares(self) -> Floats:
        """(scenes,) share of the sessions that begin in each, the most popular first."""
        return zipf(self.scenes, self.scene_exponent)

    def place_shares(self) -> Floats:
        """(places,) likewise within a scene."""
        return zipf(self.places, self.place_exponent)


def zipf(count: int, exponent: float) -> Floats:
    """(count,) shares that fall with the rank to the power of `exponent`; they sum to 1."""
    weights = np.arange(1, count + 1, dtype=float) ** -exponent
    return np.asarray(weights / weights.sum())


def visits(city: City, count: int, generator: np.random.Generator) -> Iterator[tuple[int, int]]:
    """(scene, place) of so many queries in order, each of a user drawn at random."""
    begins = generator.random(count) < 1.0 / city.session_queries
    steps = np.where(generator.random(count) < city.walking, generator.choice((-1, 1), count), 0)
    users = generator.integers(city.users, size=count)
    new_scenes, new_places = _drawn(city, count, generator)
    scenes, places = (it.tolist() for it in _drawn(city, city.users, generator))
    for user, begin, step, scene, place in zip(
        users.tolist(), begins.tolist(), steps.tolist(), new_scenes.tolist(), new_places.tolist(), strict=True
    ):
        if begin:
            scenes[user], places[user] = scene, place
        else:
            places[user] = (places[user] + step) % city.places
        yield scenes[user], places[user]


def _drawn(city: City, count: int, generator: np.random.Generator) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where so many sessions begin. Which places of a scene are popular has nothing to do with where they lie."""
    scenes = np.searchsorted(np.cumsum(city.scene_shares()), generator.random(count)).clip(max=city.scenes - 1)
    ranks = np.searchsorted(np.cumsum(city.place_shares()), generator.random(count)).clip(max=city.places - 1)
    return scenes, spread(city.places)[ranks]


def spread(places: int) -> NDArray[np.int64]:
    """(places,) the place of each rank of popularity."""
    return np.random.default_rng(places).permutation(places)
