"""The number of replicas: the policy's laws, and that it settles under Serve's own rules, in simulated time."""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import chain, pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("ray.serve", reason="needs Ray Serve: the extra `ray`")

from ray.serve.autoscaling_policy import _apply_autoscaling_config
from ray.serve.config import AutoscalingConfig, AutoscalingContext

from mapless_ray.scaling import BUSY, QUEUED, TARGET_BUSY, TARGET_QUEUED_S, Reporter, by_device_seconds, replicas_for

shares = st.lists(st.floats(0, 1), min_size=1, max_size=20)
queues = st.lists(st.floats(0, 2), min_size=1, max_size=20)


def context(reported: dict[str, dict[str, float]] | None, target: int = 3, **more: Any) -> AutoscalingContext:
    given_ = dict.fromkeys(
        (
            "deployment_id", "deployment_name", "app_name", "running_replicas", "raw_metrics", "last_scale_up_time",
            "last_scale_down_time", "current_time", "config", "total_queued_requests",
        )
    )  # fmt: skip
    given_ |= {"total_num_requests": 0, "capacity_adjusted_min_replicas": 1, "capacity_adjusted_max_replicas": 100}
    given_ |= {"policy_state": {}, "current_num_replicas": target, "target_num_replicas": target}
    return AutoscalingContext(aggregated_metrics=reported, **(given_ | more))  # type: ignore[arg-type]


@given(shares)
def test_sharing_the_same_work_does_not_change_the_count(busy: list[float]) -> None:
    """So that adding some changes nothing of what is asked for, and the loop is open."""
    shared = [sum(busy) / (2 * len(busy))] * (2 * len(busy))
    assert replicas_for([0.0], shared) == pytest.approx(replicas_for([0.0], busy))


@given(queues, shares, st.floats(0, 1))
def test_more_waiting_or_more_work_never_asks_for_fewer(queued: list[float], busy: list[float], more: float) -> None:
    assert replicas_for([*queued, more], busy) >= replicas_for(queued, busy)
    assert replicas_for(queued, [*busy, more]) >= replicas_for(queued, busy)


@given(st.integers(1, 50))
def test_replicas_at_their_targets_stay(count: int) -> None:
    assert replicas_for([TARGET_QUEUED_S] * count, [TARGET_BUSY] * count) == pytest.approx(count)


def test_full_queues_ask_for_several_times_as_many() -> None:
    """Two seconds a replica are all that is admitted: what is refused beyond does not show."""
    assert replicas_for([2.0, 2.0], [1.0, 1.0]) == 8.0


@pytest.mark.parametrize("reported", [None, {}, {BUSY: {"a": 0.1}}, {QUEUED: {}}])
def test_no_report_changes_nothing(reported: dict[str, dict[str, float]] | None) -> None:
    assert by_device_seconds(context(reported)) == (3, {})


def test_the_policy_reads_what_replicas_report() -> None:
    reported = {QUEUED: {"a": 1.0, "b": 1.5}, BUSY: {"a": 1.0, "b": 0.5}}
    assert by_device_seconds(context(reported)) == (5.0, {})


@dataclass
class Reading:
    backlog_s: float = 0.0
    busy_s: float = 0.0


def test_a_replica_reports_the_share_since_it_last_did() -> None:
    now_s, load = [100.0], Reading(0.3, 50.0)
    reporter = Reporter(load, lambda: now_s[0])
    now_s[0], load.busy_s = 110.0, 55.0
    assert reporter.report() == {QUEUED: 0.3, BUSY: 0.5}
    now_s[0], load.backlog_s = 120.0, 0.0
    assert reporter.report() == {QUEUED: 0.0, BUSY: 0.0}


def test_a_share_is_never_above_one() -> None:
    now_s, load = [0.0], Reading()
    reporter = Reporter(load, lambda: now_s[0])
    now_s[0], load.busy_s = 1.0, 1.01  # clocks are read one after the other
    assert reporter.report()[BUSY] == 1.0


POLICY = _apply_autoscaling_config(by_device_seconds)
"""With what Serve puts around it."""


@dataclass
class Fleet:
    """Replicas, second by second: what they are to compute, what waits, and how many replicas Serve then requests.

    Attributes:
        config: Serve's.
        start_s: from the decision until a replica computes.
        admitted_s: what one lets wait at most; the rest is refused.
        look_back: seconds over which Serve averages what replicas report.
    """

    config: AutoscalingConfig
    start_s: int = 40
    admitted_s: float = 2.0
    look_back: int = 30
    target: int = 2
    queue_s: float = 0.0
    refused_s: float = 0.0
    now_s: int = 0
    running: int = 2
    starting: deque[int] = field(default_factory=deque)
    state: dict[str, Any] = field(default_factory=dict)

    def run(self, loads: Iterable[float], monkeypatch: pytest.MonkeyPatch) -> list[int]:
        """How many Serve wants after each second of so much computing asked for."""
        seen: deque[tuple[float, float]] = deque(maxlen=self.look_back)
        targets = []
        monkeypatch.setattr("ray.serve.autoscaling_policy.time.time", lambda: float(self.now_s))
        for load in loads:
            self.now_s += 1
            self.running += sum(at_s == self.now_s for at_s in self.starting)
            self.starting = deque(at_s for at_s in self.starting if at_s > self.now_s)
            seen.append(self._compute(load))
            self._become(self._wanted(np.mean(seen, axis=0)))
            targets.append(self.target)
        return targets

    def _compute(self, load: float) -> tuple[float, float]:
        """The queue of a replica, and how busy it is; replicas share evenly."""
        done = min(self.queue_s + load, self.running)
        left = self.queue_s + load - done
        self.queue_s = min(left, self.admitted_s * self.running)
        self.refused_s += left - self.queue_s
        return self.queue_s / self.running, done / self.running

    def _wanted(self, reported: Any) -> int:
        """How many Serve wants, its limits and delays applied."""
        names = [str(number) for number in range(self.running)]
        metrics = {QUEUED: dict.fromkeys(names, reported[0]), BUSY: dict.fromkeys(names, reported[1])}
        about = {"current_num_replicas": self.running, "config": self.config, "policy_state": self.state}
        wanted, self.state = POLICY(context(metrics, self.target, **about))
        return min(max(wanted, self.config.min_replicas), self.config.max_replicas)

    def _become(self, wanted: int) -> None:
        self.starting.extend([self.now_s + self.start_s] * (wanted - self.target))
        for _ in range(self.target - wanted):
            if self.starting:
                self.starting.pop()
            else:
                self.running -= 1
        self.target = wanted


def poisson(per_s: float, seconds: int, call_s: float = 0.2, seed: int = 0) -> list[float]:
    """Computing asked for in each second, by calls of that length that come by chance."""
    return list(call_s * np.random.default_rng(seed).poisson(per_s / call_s, seconds))


def turns(targets: list[int]) -> int:
    """How often it went down after it had gone up, or up after down."""
    ways = [math.copysign(1, b - a) for a, b in pairwise(targets) if a != b]
    return sum(a != b for a, b in pairwise(ways))


CONFIG = AutoscalingConfig(min_replicas=2, max_replicas=40, upscale_delay_s=10, downscale_delay_s=300)


@pytest.mark.parametrize("load", [1.0, 5.6, 12.0])
def test_a_constant_load_settles_at_the_target(load: float, monkeypatch: pytest.MonkeyPatch) -> None:
    targets = Fleet(CONFIG).run(poisson(load, 2400), monkeypatch)
    settled = targets[900:]
    needed = max(math.ceil(load / TARGET_BUSY), 2)
    assert needed <= min(settled)
    assert max(settled) <= needed + 1


def test_a_tenfold_load_adds_replicas_and_removes_them(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(CONFIG)
    targets = fleet.run([*poisson(1.0, 300), *poisson(10.0, 600)], monkeypatch)
    refused_s = fleet.refused_s
    assert refused_s < 10 * 180  # three minutes' worth
    targets += fleet.run([*poisson(10.0, 600), *poisson(1.0, 900)], monkeypatch)
    assert fleet.refused_s == refused_s  # and nothing later
    assert targets[-1] == 2
    assert turns(targets) <= 2 * len(targets) / CONFIG.downscale_delay_s  # at most one up and down in that time


def test_a_load_faster_than_the_delays_causes_no_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A minute up, a minute down: replicas that come when they are not needed any more are of no use."""
    minutes = [poisson(load, 60, seed=i) for i, load in enumerate([2.0, 5.0] * 20)]
    targets = Fleet(CONFIG).run(chain.from_iterable(minutes), monkeypatch)
    assert turns(targets[900:]) <= 2
