"""A token that asks without end, as a new client with each call, leaves a fleet its answers; on a virtual clock.

And however many tokens ask, what is admitted is bounded, and waits no longer than it may.
"""

import math
import random
from statistics import median

import pytest

from mapless_server.scheduling import WorkQueueOptions
from mapless_server.scheduling.shares import CREDIT_S, MAX_IDLE
from research.neighbours import THREADS, fleet, longest_wait, most_booked, next_client

BOUND_S = THREADS * WorkQueueOptions().max_queued_s


@pytest.mark.parametrize("robots", [1, 4])
@pytest.mark.parametrize("ids", ["one", "new"])
def test_a_neighbour_leaves_a_fleet_its_answers(ids: str, robots: int) -> None:
    alone, beside = fleet(None, robots), fleet(ids, robots)
    assert len(beside.seconds) >= 0.9 * len(alone.seconds)
    assert median(beside.seconds) <= 1.5 * median(alone.seconds)


def test_a_busy_client_leaves_room_for_the_next_of_its_token() -> None:
    answered, computed = next_client(1)
    assert answered == 1
    assert computed > 0.99


@pytest.mark.parametrize("tokens", [1, 10, 30, 100])
def test_calls_wait_no_longer_however_many_tokens_ask(tokens: int) -> None:
    """Each has one call at a time. Those that have been refused for longer come before calls that wait already."""
    assert longest_wait(tokens) <= 2 * WorkQueueOptions().max_queued_s


@pytest.mark.parametrize("cost_s", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("tokens", [1, 10, 100, 400])
def test_any_number_of_tokens_books_a_bounded_time(tokens: int, cost_s: float) -> None:
    """The k-th of equal callers books at most a k-th of the bound, and none books less than a job."""
    most_s = BOUND_S * (1 + math.log(BOUND_S / cost_s))
    assert most_booked([0.0] * tokens, cost_s) <= most_s
    assert most_booked([0.0] * tokens, cost_s, in_turns=True) <= BOUND_S + 1e-6


@pytest.mark.parametrize("cost_s", [0.05, 0.2, 0.5])
@pytest.mark.parametrize("levels", ["equal steps", "random"])
def test_tokens_that_were_away_book_a_bounded_time(levels: str, cost_s: float) -> None:
    """Each comes before those that came before it, as far as what it has been given less counts."""
    count = MAX_IDLE + 50
    steps = [CREDIT_S * i / (MAX_IDLE - 1) for i in range(MAX_IDLE)]
    drawn = random.Random(7)
    given_s = steps if levels == "equal steps" else [drawn.uniform(0, 2 * CREDIT_S) for _ in range(count)]
    reach_s = BOUND_S + CREDIT_S
    assert most_booked(sorted(given_s, reverse=True), cost_s) <= reach_s * (1 + math.log(reach_s / cost_s))
