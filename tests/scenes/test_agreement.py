"""Whether a scene contradicts itself, from the errors of its pairs."""

from itertools import combinations

import pytest

from mapless_server.scenes.agreement import Agreement, agreement_of

GOOD, BAD = 0.4, 60.0


def session(prefix: str, count: int, error_px: float) -> dict[tuple[str, str], float]:
    return dict.fromkeys(combinations([f"{prefix}{i}" for i in range(count)], 2), error_px)


def between(first: str, second: str, count: int, error_px: float) -> dict[tuple[str, str], float]:
    return {(f"{first}{i}", f"{second}{j}"): error_px for i in range(count) for j in range(count)}


@pytest.mark.parametrize(
    ("errors_px", "contradicts"),
    [
        ({}, False),
        ({("a", "b"): BAD}, False),
        ({("a", "b"): BAD, ("b", "c"): BAD}, False),
        ({("a", "b"): BAD, ("b", "c"): BAD, ("c", "d"): BAD}, True),
        (session("a", 3, GOOD) | {(f"a{i}", "wrong"): BAD for i in range(3)} | {("a4", "wrong"): BAD}, False),
        ({("a", "b"): GOOD, ("b", "c"): BAD, ("a", "c"): BAD}, False),
        (session("a", 5, GOOD), False),
        (session("a", 3, BAD), True),
        (session("a", 5, GOOD) | {(f"a{i}", "wrong"): BAD for i in range(5)}, False),
        (session("a", 4, GOOD) | session("b", 4, BAD) | between("a", "b", 4, BAD), True),
    ],
)
def test_a_scene_contradicts_itself_if_most_pairs_do(
    errors_px: dict[tuple[str, str], float], contradicts: bool
) -> None:
    found = agreement_of(errors_px)
    assert found.contradicts_itself == contradicts
    assert bool(found.contradiction) == contradicts
    assert (found.pair_count, found.agreeing_count) == (len(errors_px), sum(it == GOOD for it in errors_px.values()))


def test_two_sessions_with_worlds_of_their_own_are_found() -> None:
    worlds = session("a", 9, GOOD) | session("b", 7, GOOD)
    found = agreement_of(worlds | between("a", "b", 3, BAD))
    assert 2 * found.agreeing_count > found.pair_count
    assert found.group_sizes == (9, 7)
    assert "9 and 7 references" in found.contradiction
    # A pair that agrees by chance joins no worlds; sessions that do agree, or share nothing, are no contradiction.
    assert agreement_of(worlds | between("a", "b", 3, BAD) | {("a0", "b0"): GOOD}).group_sizes == (9, 7)
    assert agreement_of(worlds | between("a", "b", 3, GOOD)) == Agreement(66, 66, GOOD)
    assert agreement_of(worlds).group_sizes == ()
