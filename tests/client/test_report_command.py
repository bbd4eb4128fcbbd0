"""The weekly report of a scene, as an operator reads it; planted counts."""

import json
from collections.abc import Callable
from datetime import date

import pytest
from support.commands import run_client
from support.servers import RunningServer

from mapless import AdoptionPolicy, Client
from mapless.cli.report import reasons
from mapless_server.security import SceneKey
from mapless_server.store import Store, adoption, counts
from mapless_server.store.counts import LOCALIZED, CountKey, Sums

Run = Callable[..., tuple[int, str, str]]
LAST = date(2026, 3, 15)
TODAY = (LAST - date(1970, 1, 1)).days


@pytest.fixture
def run(server: RunningServer, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command, which prints text: exit code, output and error output."""
    return lambda *arguments: run_client(capsys, "--address", server.address, "scene", "report", *arguments)


@pytest.fixture
def aging(server: RunningServer, scene: str) -> tuple[Store, str]:
    """A scene of which r1 was localized in the first week and half the time in the second; r0 had dark photographs."""
    store: Store = server.engine.references.retrievals[0].indexes._store
    key, other = (store.find_keys(SceneKey(scene), [it])[it] for it in ("r1", "r0"))
    beyond = Sums(8, position_count=8, offset_x=16.0, squared_offset=32.0, forward_z=8.0)
    planted = {
        CountKey(TODAY - 7, key, LOCALIZED): Sums(20, 20, 20.0, 4000, 20, -80.0),
        CountKey(TODAY, key, LOCALIZED): Sums(10, 10, 4.0, 1000, 10, -30.0),
        CountKey(TODAY, key, "low_overlap"): beyond,
        CountKey(TODAY, key, "gate"): Sums(2),
        CountKey(TODAY - 1, other, "low_texture"): Sums(3),
    }
    counts.add_counts(store.database, {SceneKey(scene): planted})
    return store, scene


def test_an_operator_sees_weeks_places_and_what_helps(run: Run, aging: tuple[Store, str]) -> None:
    _, scene = aging
    code, text, _ = run(scene, "--text", "--weeks", 2, "--until", LAST)
    lines = text.splitlines()
    assert (code, lines[0]) == (0, f"{scene}, 2026-03-02 to 2026-03-15 (UTC)")
    assert lines[3].split() == ["2026-03-02", "20", "100", "%", "1.8", "cm", "200", "100", "%"]
    week = "2026-03-09           23       43 %       5.0 cm      100      40 %  LOW_OVERLAP 8, LOW_TEXTURE 3, GATE 2"
    assert lines[4] == week
    assert [it.split()[:3] for it in lines[8:10]] == [["r1", "10", "40"], ["r0", "3", "3"]]
    advice = " ".join(it.strip() for it in lines[lines.index("What would help most:") + 1 :])
    assert advice.startswith(
        "1. 10 of 40 photographs around r1 were rejected, most often LOW_OVERLAP (too little in common"
    )
    assert "2 m from r1, looking along (0.0, 0.0, 1.0): add references there" in advice
    assert "r0 were rejected" not in advice  # dark photographs


def test_a_bad_week_and_an_outdated_place_are_exit_codes(run: Run, aging: tuple[Store, str], client: Client) -> None:
    store, scene = aging
    period = ["--text", "--until", LAST, "--alert-below"]
    assert run(scene, *period, "0.9")[0] == 0  # 23 photographs are too few to judge
    counts.add_counts(store.database, {SceneKey(scene): {CountKey(TODAY - 6, "", LOCALIZED): Sums(27)}})
    for by in ([], ["--by-day"]):  # 37 of 50; on the last day 10 of 20
        assert [run(scene, *by, *period, share)[0] for share in ("0.74", "0.75")] == [0, 3]
    assert (
        "\nTo do: 74 % of the last 7 days' 50 photographs were localized, less than 75 %\n"
        in run(scene, *period, "0.75")[1]
    )
    client.update_scene(scene, adoption=AdoptionPolicy())
    keys = store.find_keys(SceneKey(scene), ["r1", "r2"])
    adoption.change_standings(store.database, keys.values(), lambda _, it: adoption.outdated(it))
    code, text, _ = run(scene, *period, "0.4")
    assert code == 3
    assert "\nTo do: 2 places need a new survey\n" in text
    assert "Places that need a new survey: r1 at (1.00, 2.00, -1.00), r2 at (2.00, 2.00, -1.00)\n" in text
    assert "the place has changed: survey it again, around (3.00, 2.00, -1.00)" in " ".join(text.split())


def test_what_was_adopted_and_retired_is_summed_by_reason(run: Run, aging: tuple[Store, str]) -> None:
    store, scene = aging
    planted = {("adoptions", "adopted"): 3, ("adoptions", "nothing_new"): 5, ("retirements", "contradicted"): 2}
    happened = {CountKey(TODAY, "", counts.happening(*it)): Sums(count) for it, count in planted.items()}
    counts.add_counts(store.database, {SceneKey(scene): happened})
    _, text, _ = run(scene, "--text", "--until", LAST)
    shown = "adopted      3\nnot adopted  nothing_new 5\nretired      2 by servers (contradicted 2)\n"
    assert shown in text


def test_a_report_says_its_reason_without_photographs(run: Run, server: RunningServer, scene: str) -> None:
    store: Store = server.engine.references.retrievals[0].indexes._store
    keys = store.find_keys(SceneKey(scene), ["r1"])
    adoption.change_standings(store.database, keys.values(), lambda _, it: adoption.outdated(it))
    code, text, _ = run(scene, "--text", "--alert-below", "0.5")
    assert code == 3
    for said in (
        "To do: a place needs a new survey",
        "no photographs were counted",
        "new survey: r1 at (1.00, 2.00, -1.00)",
    ):
        assert said in text


def test_what_was_retired_by_hand_is_in_the_report(run: Run, client: Client, scene: str) -> None:
    client.retire_reference(scene, "r1")
    head, row = run(scene, "--text")[1].splitlines()[-2:]
    assert head.split() == ["REFERENCE", "RETIRED", "ON"]
    assert row.startswith("r1")
    assert row.endswith("by request of a caller who may change the scene")


def test_reasons_add_up_to_all_rejections() -> None:
    assert reasons({"GATE": 2, "AMBIGUOUS": 2, "LOW_OVERLAP": 8, "PNP_FAILED": 1, "LOW_TEXTURE": 1}) == (
        "LOW_OVERLAP 8, AMBIGUOUS 2, GATE 2, others 2"
    )


def test_programs_get_all_of_it(run: Run, aging: tuple[Store, str]) -> None:
    _, scene = aging
    found = json.loads(run(scene, "--json", "--since", LAST, "--until", LAST, "--by-day")[1])
    (period,) = found["periods"]
    assert (period["first_day"], period["rejections"]) == ("2026-03-15", {"LOW_OVERLAP": 8, "GATE": 2})
    assert found["places"][0]["rejected_position"]["photograph_count"] == 8


def test_a_scene_without_photographs_says_so(run: Run, scene: str) -> None:
    code, text, _ = run(scene, "--text", "--alert-below", "0.9")
    assert (code, text.splitlines()[-1]) == (0, "no photographs were counted")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--since", "monday"], "no day such as 2026-11-02"),
        (["--weeks", "0"], "must be 1 to 500"),
        (["--weeks", "4", "--since", "2026-03-01"], "not allowed with"),
        (["--since", "20260301"], "no day such as 2026-11-02"),
        (["--alert-below", "90"], "must be 0 to 1"),
        (["--until", "0001-01-01"], "must be 1970-01-01 or later"),
        (["--until", "9999-01-01"], "--until 9999-01-01 is after today"),
        (["--since", "9999-01-01"], "--since 9999-01-01 is after today"),
        (["--since", "2026-03-02", "--until", "2026-03-01"], "--since 2026-03-02 is after --until 2026-03-01"),
    ],
)
def test_wrong_days_are_named(run: Run, scene: str, arguments: list[str], said: str) -> None:
    code, _, error = run(scene, *arguments)
    assert code == 2
    assert said in error
