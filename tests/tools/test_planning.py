"""What the plan of a city is computed by agrees with closed forms, and its fleet with what its parts promise."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapless_tools.evaluate.svg import draw
from mapless_tools.planning import figures
from mapless_tools.planning.__main__ import main
from mapless_tools.planning.caching import LeastRecentlyUsed, expected_hit_rate
from mapless_tools.planning.city import City, visits, zipf
from mapless_tools.planning.curves import (
    DEVICES,
    DISTRICTS,
    SECONDS,
    SEED,
    SETTLED_S,
    cached_places,
    charts,
    of_ranking,
    svg,
)
from mapless_tools.planning.fleet import Fleet, Routing, districts_of, fullest_district, preferences, simulate
from mapless_tools.planning.queueing import latencies_s, spread_services, waiting_probability, waiting_quantile_s

CITY = Path(__file__).parents[2] / "deploy" / "city"
TOWN = City(scenes=60, places=20, queries_per_s=40.0, users=40)
"""Small enough for a test; 4 devices of 72 ms are busy for 0.7 of the time."""

# Memory


@given(st.lists(st.integers(0, 9), max_size=60), st.integers(0, 6))
def test_what_is_least_recently_used_is_forgotten_first(asked: list[int], capacity: int) -> None:
    memory = LeastRecentlyUsed[int](capacity)
    for i, key in enumerate(asked):
        recent = list(dict.fromkeys(reversed(asked[:i])))[:capacity]
        assert memory.ask(key) == (key in recent)
        assert len(memory) <= capacity


@pytest.mark.parametrize("exponent", [0.6, 0.9, 1.2])
@pytest.mark.parametrize("capacity", [20, 200])
def test_hit_rates_are_those_of_ches_approximation(exponent: float, capacity: int) -> None:
    shares = zipf(1000, exponent)
    keys = np.random.default_rng(0).choice(1000, 60_000, p=shares).tolist()
    memory = LeastRecentlyUsed[int](capacity)
    hits = [memory.ask(key) for key in keys]
    assert np.mean(hits[10_000:]) == pytest.approx(expected_hit_rate(shares, capacity), abs=0.015)


def test_hit_rates_at_the_ends() -> None:
    shares = zipf(50, 0.9)
    assert expected_hit_rate(shares, 0) == 0
    assert expected_hit_rate(shares, 50) == 1
    assert expected_hit_rate(np.full(100, 0.01), 30) == pytest.approx(0.3)  # nothing is more popular than anything else


# Queues


def test_erlangs_formula_at_what_is_known_of_it() -> None:
    for load in (0.1, 0.5, 0.9):
        assert waiting_probability(1, load) == pytest.approx(load)  # one server: it waits who finds it busy
    assert waiting_probability(2, 1.0) == pytest.approx(1 / 3)
    assert waiting_probability(3, 3.0) == 1.0
    assert waiting_quantile_s(3, 10.0, 0.3, 0.99) == math.inf
    assert waiting_quantile_s(1, 5.0, 0.1, 0.99) == pytest.approx(0.1 / 0.5 * math.log(0.5 / 0.01))


@pytest.mark.parametrize(("servers", "load"), [(1, 0.6), (4, 0.8), (20, 0.9)])
def test_the_simulated_queue_waits_as_erlang_says(servers: int, load: float) -> None:
    generator, count = np.random.default_rng(servers), 200_000
    gaps_s = generator.exponential(1 / (servers * load), count)
    services_s = generator.exponential(1.0, count)
    waits_s = latencies_s(servers, gaps_s, services_s) - services_s
    assert np.mean(waits_s > 1e-9) == pytest.approx(waiting_probability(servers, servers * load), abs=0.03)
    expected_s = waiting_quantile_s(servers, servers * load, 1.0, 0.95)
    assert np.quantile(waits_s, 0.95) == pytest.approx(expected_s, rel=0.1)


def test_services_have_the_mean_and_the_spread_that_were_asked_for() -> None:
    drawn_s = spread_services(0.072, 0.16, 100_000, np.random.default_rng(0))
    assert drawn_s.mean() == pytest.approx(0.072, rel=0.01)
    assert np.log(drawn_s).std() == pytest.approx(0.16, rel=0.02)


# The city


def test_the_city_is_the_one_of_the_plan() -> None:
    assert City().reference_count == 10_000_000
    assert City().queries_per_s == 1000


@given(st.integers(1, 300), st.floats(0, 2))
def test_shares_fall_with_the_rank_and_are_all_there_is(count: int, exponent: float) -> None:
    shares = zipf(count, exponent)
    assert shares.sum() == pytest.approx(1)
    assert (np.diff(shares) <= 0).all()
    assert shares[-1] * count**exponent == pytest.approx(shares[0])


def test_users_stay_walk_on_or_begin_anew() -> None:
    alone = replace(TOWN, users=1)
    seen = list(visits(alone, 20_000, np.random.default_rng(0)))
    moves = [
        (place - before) % alone.places if scene == scene_before else None
        for (scene_before, before), (scene, place) in zip(seen, islice(seen, 1, None), strict=False)
    ]
    # A new session may begin where the last one ended, so a little more than the share of those who stay.
    assert moves.count(0) / len(moves) == pytest.approx(0.95 * 0.8, abs=0.02)
    assert moves.count(1) / len(moves) == pytest.approx(0.95 * 0.1, abs=0.01)
    assert moves.count(alone.places - 1) / len(moves) == pytest.approx(0.95 * 0.1, abs=0.01)


def test_popular_scenes_are_asked_for_as_often_as_their_share() -> None:
    scenes = [scene for scene, _ in visits(replace(TOWN, session_queries=1.0), 50_000, np.random.default_rng(1))]
    assert np.bincount(scenes, minlength=60) / 50_000 == pytest.approx(TOWN.scene_shares(), abs=0.005)


# The fleet


@pytest.mark.parametrize("routing", Routing)
def test_the_same_seed_gives_the_same(routing: Routing) -> None:
    runs = [simulate(TOWN, Fleet(4, 100, routing), 20, seed=3) for _ in range(2)]
    assert np.array_equal(runs[0].latencies_s, runs[1].latencies_s)
    assert np.array_equal(runs[0].devices, runs[1].devices)
    assert not np.array_equal(runs[0].arrivals_s, simulate(TOWN, Fleet(4, 100, routing), 20, seed=4).arrivals_s)


def test_a_device_that_is_lost_moves_its_own_scenes_and_no_others() -> None:
    order = preferences(200, 8)
    before = order[:, 0]
    after = np.array([next(device for device in each if device != 3) for each in order])
    assert np.array_equal(before[before != 3], after[before != 3])
    assert (after != 3).all()
    assert len(set(after[before == 3])) > 1  # not all to one neighbour


def test_calls_of_a_scene_come_to_one_device_and_more_of_them_are_in_memory() -> None:
    runs = {routing: simulate(TOWN, Fleet(4, 200, routing), 60, seed=1) for routing in Routing}
    assert runs[Routing.SCENE].hit_rate > runs[Routing.SCENE_BOUNDED].hit_rate > runs[Routing.LOAD].hit_rate
    # And what that costs where one scene is asked for too often.
    busiest = {
        routing: np.bincount(run.devices).max() / np.bincount(run.devices).mean() for routing, run in runs.items()
    }
    assert busiest[Routing.SCENE] > busiest[Routing.SCENE_BOUNDED]


@pytest.mark.parametrize("balance", [1.25, 1.5, 2.0])
def test_nobody_has_more_than_the_bounded_share_under_way(balance: float) -> None:
    run = simulate(TOWN, Fleet(4, 100, balance=balance), 30, seed=2)
    ends_s = run.arrivals_s + run.latencies_s
    for i in range(0, len(run.arrivals_s), 7):
        under_way = run.devices[:i][ends_s[:i] > run.arrivals_s[i]]
        before = np.count_nonzero(under_way == run.devices[i])
        assert before < math.ceil(balance * (len(under_way) + 1) / 4)


def test_devices_compute_what_was_asked_of_them() -> None:
    everything = Fleet(4, 2000, Routing.LOAD, spread=0.0)
    run = simulate(TOWN, everything, 200, seed=5)
    assert run.hit_rate == 1  # all places fit, and are there from the beginning
    assert run.busy == pytest.approx(TOWN.queries_per_s * everything.service_s / 4, rel=0.05)
    nothing = simulate(TOWN, replace(everything, cached_places=0, devices=8), 200, seed=5)
    assert nothing.hit_rate == 0
    service_s = everything.service_s + 10 * everything.miss_s
    assert nothing.busy == pytest.approx(TOWN.queries_per_s * service_s / 8, rel=0.05)
    assert nothing.latencies_s.min() == pytest.approx(service_s)


def test_after_a_loss_nothing_goes_to_what_is_lost() -> None:
    for routing in Routing:
        run = simulate(TOWN, Fleet(8, 100, routing), 20, seed=1, lost=2, lost_at_s=10.0)
        assert set(run.devices[run.arrivals_s >= 10.0]) <= set(range(2, 8))
        assert set(run.devices[run.arrivals_s < 10.0]) & {0, 1}


@pytest.mark.parametrize("routing", Routing)
def test_scenes_of_a_district_are_answered_by_its_devices_alone(routing: Routing) -> None:
    fleet = Fleet(12, 100, routing, districts=3)
    run = simulate(TOWN, fleet, 60, seed=1, lost=6, lost_at_s=30.0)
    parts = [run.of_district(district, 3) for district in range(3)]
    assert sum(len(part.hits) for part in parts) == len(run.hits)
    shares = np.bincount(districts_of(TOWN.scenes, 3), TOWN.scene_shares(), 3)
    for district, part in enumerate(parts):
        assert set(part.devices) == set(range(district, 12, 3))
        # Of devices in a row each district loses as many.
        assert set(part.devices[part.arrivals_s >= 30.0]) == {6 + district, 9 + district}
        assert len(part.hits) / len(run.hits) == pytest.approx(shares[district], abs=0.07)
    assert fullest_district(TOWN, 3) == (int(shares.argmax()), float(shares.max()))


@pytest.mark.parametrize(("districts", "in_half", "in_one_of_ten"), [(4, 0.30, 0.33), (8, 0.18, 0.21)])
def test_the_fullest_district_is_as_full_as_chance_makes_it(
    districts: int, in_half: float, in_one_of_ten: float
) -> None:
    shares, generator = City().scene_shares(), np.random.default_rng(0)
    fullest = [np.bincount(generator.integers(districts, size=len(shares)), shares).max() for _ in range(500)]
    assert np.quantile(fullest, 0.5) == pytest.approx(in_half, abs=0.005)
    assert np.quantile(fullest, 0.9) == pytest.approx(in_one_of_ten, abs=0.005)
    if districts == DISTRICTS:
        assert fullest_district(City(), districts)[1] == pytest.approx(in_one_of_ten, abs=0.005)
        assert f"in one of ten more than {100 * in_one_of_ten:.0f} %" in " ".join(
            (CITY / "README.md").read_text().split()
        )


@settings(max_examples=20)
@given(
    st.sampled_from(
        [
            {"devices": 0},
            {"districts": 5},
            {"districts": 0},
            {"cached_places": -1},
            {"balance": 1.0},
            {"service_s": 0.0},
            {"miss_s": -1.0},
        ]
    )
)
def test_a_fleet_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(Fleet(4, 100), **wrong)  # type: ignore[arg-type]


# What is drawn


def test_figures_are_those_of_the_benchmarks() -> None:
    """Not of memory: what is measured anew has to be planned with anew."""
    text = (Path(__file__).parents[2] / "BENCHMARKS.md").read_text()
    assert f"98 % of two cores by {figures.CPU_S_PER_QUERY:g} CPU seconds an answer" in " ".join(text.split())
    assert "| one at a time | 58 | 1.96 | 0 | 513 / 649 / 740 |" in text
    assert math.log(740 / 513) / 2.326 == pytest.approx(figures.CPU_SPREAD, abs=0.005)
    assert f"| mapless, no-op | 2.65 | 3.56 | 412 | {1000 * figures.SERVING_CPU_S:.2f} |" in text
    assert f"| {1000 * figures.GPU_S_PER_QUERY:.0f} | 60 |" in text
    assert pytest.approx((0.091 - figures.GPU_S_PER_QUERY) / 10) == figures.GPU_S_PER_MISSED_REFERENCE
    assert "| pi3 | everything | 34.34 | 12.45 | 43.5 | 115 | 91 | 90 |" in text
    assert f"| tokens of 100 references | {figures.TOKEN_BYTES / 1e7:.2f} GB |" in text
    assert f"| load 10 by name, from the database | 2.3 / 3.9 | {figures.DATABASE_LOAD_MS:g} / 16 |" in text
    for (references, ranking_ms), (_, index_bytes) in zip(figures.RANKING_MS, figures.INDEX_BYTES, strict=True):
        row = rf"| {references:,.0f} | {ranking_ms:g} ms |"
        assert row in text
        assert f"| {index_bytes:.0f} bytes |" in text


def test_a_chart_is_a_file_of_its_own() -> None:
    drawn = svg(of_ranking())
    assert drawn.startswith('<svg xmlns="http://www.w3.org/2000/svg"')
    assert drawn.count("<polyline") == draw(of_ranking()).count("<polyline") == 2


@pytest.mark.thorough
def test_the_plan_shows_what_the_simulation_gives() -> None:
    """Its pictures, and the figures that its text rests on."""
    text = " ".join((CITY / "README.md").read_text().split())
    drawn = dict(charts(City()))
    assert {path.stem for path in (CITY / "curves").iterdir()} == set(drawn)
    for name, chart in drawn.items():
        assert (CITY / "curves" / f"{name}.svg").read_text() == svg(chart), name
        assert f"(curves/{name}.svg)" in text

    def at(name: str, curve: str, x: float) -> float:
        (found,) = [it for it in drawn[name].curves if it.name == curve]
        return dict(found.points)[x]

    by_scene, by_load, fine = Routing.SCENE_BOUNDED.value, Routing.LOAD.value, "10,000 scenes"
    hits, p99_ms = at("memory", by_scene, 100), at("devices", by_scene, 144)
    assert f"in the device's memory | {hits:.0f} % after half a minute" in text
    assert f"in the fullest district alone | {p99_ms:.0f} ms |" in text
    fleet = Fleet(DEVICES, cached_places(City()), districts=DISTRICTS)
    long = simulate(City(), fleet, 300, SEED)
    assert f"half a minute, {100 * long.hits[long.arrivals_s >= 270].mean():.0f} % after five" in text
    short = simulate(City(), fleet, SECONDS, SEED)
    assert f"it is {short.busy * DEVICES:.0f} of {DEVICES}" in text
    fullest = short.of_district(fullest_district(City(), DISTRICTS)[0], DISTRICTS)
    missed = 1 - fullest.hits[fullest.arrivals_s >= SETTLED_S].mean()
    assert f"{100 * missed:.0f} % of its 330 queries/s" in text
    assert (hits, p99_ms) == (at("balance-hits", fine, 150), at("balance-p99", fine, 150))  # one run, told thrice
    assert f"{at('memory', by_load, 100):.0f} % of the queries find their references" in text
    assert f"it is {hits:.0f} %, and {at('memory', by_scene, 5):.0f} % with 5 GB" in text
    narrow = f"at 1.25 it is {at('balance-p99', fine, 125):.0f} ms, with {at('balance-hits', fine, 125):.0f} % instead"
    assert f"At 1.5, as in the manifests, p99 is {p99_ms:.0f} ms; {narrow} of {hits:.0f}" in text
    wide = f"At 3 it is {at('balance-hits', fine, 300):.0f} %, and p99 is {at('balance-p99', fine, 300) / 1000:.0f} s"
    assert wide in text
    few, many = at("devices", by_scene, 128), at("devices", by_scene, 176)
    assert f"At 128 devices p99 is {few:.0f} ms, at 144 {p99_ms:.0f} ms, at 176 {many:.0f} ms" in text
    assert f"112 would do for {at('devices', 'by scene, undivided city', 112):.0f} ms" in text
    assert f"By load alone p99 is {at('devices', by_load, 144):.0f} ms at 144" in text
    assert f"its p99 is {at('devices', 'one queue, sigma 0.16', 112):.0f} ms" in text
    assert f"p99 is {at('devices', 'one queue, sigma 0.6', 176):.0f} ms even" in text
    assert f"as 112 do: p99 {at('devices', by_scene, 112) / 1000:.1f} s" in text
    windows = dict(next(it for it in drawn["loss"].curves if it.name == "p99, by scene").points)
    before, after = (max(p99 for at_s, p99 in windows.items() if (at_s > 0) is late) for late in (False, True))
    assert f"at most {after:.0f} ms, {before:.0f} before" in text
    assert f"at most {after:.0f} ms in any 2.5 s" in text
    misses = dict(next(it for it in drawn["loss"].curves if it.name == "misses, by scene").points)
    assert max(it for at_s, it in misses.items() if at_s > 0) < max(it for at_s, it in misses.items() if at_s < 0)


def test_without_a_folder_the_command_says_what_it_wants(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "FOLDER" in capsys.readouterr().err
