"""How calls find devices: by their scene, by the load, or both; and how they wait there for what is before them.

Each device answers one call at a time and keeps the references of so many places in memory. Those of a place that is
not there are computed in the device. A fleet may be divided into districts, which have scenes and devices of their own.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from .caching import LeastRecentlyUsed
from .city import City, Floats, spread, visits
from .figures import GPU_S_PER_MISSED_REFERENCE, GPU_S_PER_QUERY
from .queueing import spread_services

DEAL = 50
"""Seed that deals scenes to districts: the fullest of four gets 33 % of the queries; one deal in ten gives more."""


class Routing(Enum):
    """How a call finds a device."""

    SCENE_BOUNDED = "by scene, bounded load"
    """The scene's own device, and the next ones of its order where that has more than its bounded share under way."""
    SCENE = "by scene alone"
    LOAD = "by load alone"
    """The less busy one of two drawn at random."""


@dataclass(frozen=True)
class Fleet:
    """Devices, and what is known of them.

    Attributes:
        devices: how many.
        cached_places: whose references fit into the memory of one.
        districts: into which scenes and devices are divided; a call finds only devices of its scene's district.
        routing: how calls find them.
        balance: what a device may have under way, as a multiple of the average; that of the manifests.
        service_s: computing for a call whose references are in memory.
        miss_s: and for each reference that is not.
        spread: standard deviation of the logarithm of both together.
    """

    devices: int
    cached_places: int
    routing: Routing = Routing.SCENE_BOUNDED
    balance: float = 1.5
    service_s: float = GPU_S_PER_QUERY
    miss_s: float = GPU_S_PER_MISSED_REFERENCE
    spread: float = 0.16
    districts: int = 1

    def __post_init__(self) -> None:
        if not (self.devices >= 1 and self.cached_places >= 0):
            raise ValueError("devices must be at least 1, cached_places at least 0")
        if not 1 <= self.districts <= self.devices:
            raise ValueError("districts must be at least 1, and no more than the devices")
        if not (self.balance > 1 and self.service_s > 0 and self.miss_s >= 0 and self.spread >= 0):
            raise ValueError("balance must be above 1, service_s above 0, miss_s and spread at least 0")


@dataclass(frozen=True, eq=False)
class Outcome:
    """What became of the calls, in the order of their arrival.

    Attributes:
        arrivals_s: (N,).
        latencies_s: (N,) from arrival to answer.
        hits: (N,) whether the place was in memory.
        devices: (N,) which one answered.
        busy: share of the time that the devices computed.
    """

    arrivals_s: Floats
    latencies_s: Floats
    hits: NDArray[np.bool_]
    devices: NDArray[np.int64]
    busy: float

    def of_district(self, district: int, districts: int) -> Outcome:
        """The calls of one district; `busy` remains that of all devices."""
        its = self.devices % districts == district
        return Outcome(self.arrivals_s[its], self.latencies_s[its], self.hits[its], self.devices[its], self.busy)

    @property
    def hit_rate(self) -> float:
        """Share of the calls."""
        return float(self.hits.mean())

    def quantile_s(self, share: float) -> float:
        """Latency that such a share does not exceed."""
        return float(np.quantile(self.latencies_s, share))


def preferences(scenes: int, devices: int) -> NDArray[np.int64]:
    """(scenes, devices) each scene's order of devices; without a device it is the same order without it."""
    return np.argsort(np.random.default_rng(devices).random((scenes, devices)), axis=1)


def districts_of(scenes: int, districts: int) -> NDArray[np.int64]:
    """(scenes,) the district of each: dealt by chance, as where scenes are divided before anybody has asked."""
    return np.random.default_rng(DEAL).integers(districts, size=scenes)


def fullest_district(city: City, districts: int) -> tuple[int, float]:
    """The district that most queries are for, and their share of all."""
    shares = np.bincount(districts_of(city.scenes, districts), city.scene_shares(), districts)
    return int(shares.argmax()), float(shares.max())


def simulate(
    city: City, fleet: Fleet, seconds: float, seed: int, lost: int = 0, lost_at_s: float = math.inf
) -> Outcome:
    """Poisson arrivals for so long, into memories that hold what is asked for most.

    Args:
        city: who asks.
        fleet: who answers. Device i is of district i % districts, so that devices in a row are of all of them in turn.
        seconds: how long.
        seed: the same gives the same.
        lost: so many devices, a node's, get no more calls; what they have under way then is taken for answered.
        lost_at_s: from this moment on.
    """
    generator = np.random.default_rng(seed)
    count = generator.poisson(city.queries_per_s * seconds)
    arrivals_s = np.sort(generator.random(count)) * seconds
    pace = spread_services(1.0, fleet.spread, count, generator).tolist()
    pairs = generator.integers(1 << 30, size=(count, 2)).tolist()
    district_of = districts_of(city.scenes, fleet.districts).tolist()
    order = [
        [device for device in each if device % fleet.districts == district]
        for each, district in zip(preferences(city.scenes, fleet.devices).tolist(), district_of, strict=True)
    ]
    memories = _warm(city, fleet, order)
    alive = [list(range(district, fleet.devices, fleet.districts)) for district in range(fleet.districts)]
    under_way, totals = [0] * fleet.devices, [0] * fleet.districts
    free_s = [0.0] * fleet.devices
    leaving: list[tuple[float, int]] = []
    latencies_s, hits, devices = np.empty(count), np.empty(count, bool), np.empty(count, np.int64)
    busy_s = 0.0
    asked = visits(city, count, generator)
    for i, (now_s, (scene, place)) in enumerate(zip(arrivals_s.tolist(), asked, strict=True)):
        while leaving and leaving[0][0] <= now_s:
            left = heapq.heappop(leaving)[1]
            under_way[left] -= 1
            totals[left % fleet.districts] -= 1
        if now_s >= lost_at_s:
            lost_at_s = math.inf
            alive, order = _without(lost, alive), _without(lost, order)
        district = district_of[scene]
        device = _chosen(fleet, order[scene], alive[district], under_way, totals[district], pairs[i])
        hit = memories[device].ask((scene, place))
        missed = 0 if hit else city.references_per_place
        service_s = (fleet.service_s + fleet.miss_s * missed) * pace[i]
        end_s = max(free_s[device], now_s) + service_s
        free_s[device] = end_s
        under_way[device] += 1
        totals[district] += 1
        heapq.heappush(leaving, (end_s, device))
        latencies_s[i], hits[i], devices[i] = end_s - now_s, hit, device
        busy_s += service_s
    return Outcome(arrivals_s, latencies_s, hits, devices, busy_s / (seconds * fleet.devices))


def _without(lost: int, lists: list[list[int]]) -> list[list[int]]:
    """The devices of each list but the first `lost` ones of the fleet."""
    return [[device for device in each if device >= lost] for each in lists]


def _chosen(fleet: Fleet, order: list[int], alive: list[int], under_way: list[int], total: int, pair: list[int]) -> int:
    if fleet.routing is Routing.LOAD:
        one, other = alive[pair[0] % len(alive)], alive[pair[1] % len(alive)]
        return one if under_way[one] <= under_way[other] else other
    if fleet.routing is Routing.SCENE:
        return order[0]
    most = math.ceil(fleet.balance * (total + 1) / len(alive))
    return next(device for device in order if under_way[device] < most)


def _warm(city: City, fleet: Fleet, order: list[list[int]]) -> list[LeastRecentlyUsed[tuple[int, int]]]:
    """Memories with the most popular places of the scenes whose own device each is; by load, those of all scenes."""
    scenes, places = city.scene_shares(), city.place_shares()
    at = spread(city.places)

    def most_popular(of: NDArray[np.int64]) -> LeastRecentlyUsed[tuple[int, int]]:
        shares = (scenes[of, None] * places[None, :]).ravel()
        kept = np.argsort(-shares, kind="stable")[: fleet.cached_places][::-1]
        keys = zip(of[kept // city.places].tolist(), at[kept % city.places].tolist(), strict=True)
        return LeastRecentlyUsed(fleet.cached_places, keys)

    if fleet.routing is Routing.LOAD:
        all_of = districts_of(city.scenes, fleet.districts)
        common = [most_popular(np.flatnonzero(all_of == district)) for district in range(fleet.districts)]
        return [LeastRecentlyUsed(fleet.cached_places, common[i % fleet.districts]) for i in range(fleet.devices)]
    own = np.array([each[0] for each in order])
    return [most_popular(np.flatnonzero(own == device)) for device in range(fleet.devices)]
