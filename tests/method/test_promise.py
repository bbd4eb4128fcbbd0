"""Whether a further attempt is worth its time."""

import pytest

from mapless_server.method.promise import PROMISE, UNKNOWN, WORTH, Known, PromiseOptions, Worth

ELSEWHERE, HERE = Known(agreement=1.5), Known(agreement=9.0)


def test_the_chance_of_the_place_is_a_half_at_the_given_agreement() -> None:
    assert Known(PROMISE.agreement).chance_of_place() == pytest.approx(0.5)
    assert ELSEWHERE.chance_of_place() < 0.01
    assert HERE.chance_of_place() > 0.99


@pytest.mark.parametrize("name", WORTH)
def test_a_photograph_of_elsewhere_is_not_worth_an_attempt(name: str) -> None:
    assert not ELSEWHERE.is_worth(name)


@pytest.mark.parametrize("name", ["lines", "stronger", "rematched"])
def test_a_photograph_of_the_place_is_worth_it(name: str) -> None:
    assert HERE.is_worth(name)
    assert UNKNOWN.is_worth(name)


def test_what_two_kinds_of_features_have_found_is_not_checked_by_more() -> None:
    assert Known(9.0, is_accepted=True).is_worth("stronger")
    assert not Known(9.0, is_accepted=True, kinds=2).is_worth("stronger")
    assert not Known(9.0, is_accepted=True, is_of_low_trust=False).is_worth("stronger")


def test_an_unlisted_attempt_is_always_worth_it() -> None:
    assert ELSEWHERE.is_worth("elsewhere")


def test_gain_is_the_chance_times_the_share_for_each_second() -> None:
    options = PromiseOptions(wrong_of_low_trust=0.2, wrong_if_confirmed=0.5)
    accepted = Known(9.0, is_accepted=True, kinds=2)
    assert accepted.gain_per_s(Worth(2.0, 0.9, 0.6), options) == pytest.approx(0.2 * 0.5 * 0.6 / 2)
    assert HERE.gain_per_s(Worth(2.0, 0.9, 0.6), options) == pytest.approx(0.45)


def test_wrong_options_name_their_bound() -> None:
    with pytest.raises(ValueError, match="spread must be above 0"):
        PromiseOptions(spread=0.0)
    with pytest.raises(ValueError, match=r"found must be .*at most 1"):
        Worth(1.0, 1.5, 0.0)
