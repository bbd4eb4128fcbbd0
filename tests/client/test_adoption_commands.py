"""The commands by which an operator turns adoption on, sees what was adopted and retired, and undoes it."""

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from support.commands import run_client
from support.servers import CAMERA, PHOTO, RunningServer, pose, serving

from mapless import (
    Accuracy,
    AdoptionPolicy,
    Client,
    ConnectOptions,
    NewReference,
    PermissionDenied,
    Provenance,
    RestoredReferences,
    Voucher,
)
from mapless_server.security import SceneKey, create_token
from mapless_server.store import RetirementReason, adoption

ADOPTED = Provenance("ADOPTED", Accuracy(0.01, 0.02, 0.1, 0.2), 0.5, (Voucher("r0", 40), Voucher("r1", 20)))
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(server: RunningServer, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the command, which prints text: exit code, output and error output."""
    return lambda *arguments: run_client(capsys, "--text", "--address", server.address, *arguments)


def test_adoption_is_turned_on_changed_and_off(run: Run, client: Client, scene: str) -> None:
    code, text, _ = run("scene", "update", scene, "--adopt")
    assert (code, client.get_scene(scene).adoption) == (0, AdoptionPolicy(max_radius_m=0.03))
    assert "at most 4 a place, trust 0.5, within 0.03 m (68 %), 30 % surveyed" in text
    assert run("scene", "update", scene, "--adopt", "--adopt-most", "2", "--adopt-radius", "0.1")[0] == 0
    assert client.get_scene(scene).adoption == AdoptionPolicy(most_per_place=2, max_radius_m=0.1)
    assert run("scene", "update", scene, "--adopt", "--adopt-trust", "0.7")[0] == 0
    assert client.get_scene(scene).adoption == AdoptionPolicy(most_per_place=2, max_radius_m=0.1, min_trust=0.7)
    code, _, error = run("scene", "update", scene, "--adopt", "--adopt-trust", "2")
    assert (code, "min_trust must be above 0, at most 1, is 2" in error) == (2, True)
    code, _, error = run("scene", "update", scene, "--adopt", "--adopt-trust", "0")
    assert (code, "min_trust must be above 0, at most 1, is 0" in error) == (2, True)
    assert run("scene", "update", scene, "--forget", "adoption")[0] == 0
    assert client.get_scene(scene).adoption is None


def test_adopted_references_are_shown_and_undone(run: Run, client: Client, scene: str) -> None:
    client.add_reference(scene, NewReference("new", PHOTO, CAMERA, pose(5.0), provenance=ADOPTED))
    _, text, _ = run("reference", "list", scene, "--adopted")
    assert [line.split()[:3] for line in text.splitlines()[1:]] == [["new", "50", "%"]]
    assert "r0, r1" in text
    assert "references  4 (1 adopted)\n" in run("scene", "get", scene)[1]
    found = json.loads(run("scene", "get", scene, "--json")[1])
    assert (found["adopted_reference_count"], found["retired_reference_count"]) == (1, 0)
    for action in (("update", scene, "--adopt"), ("list",)):  # which do not count them
        text = "".join(run("scene", *action, "--json")[1].split())
        assert '"adopted_reference_count":null,"retired_reference_count":null' in text
    shown = run("reference", "show", scene, "new")[1]
    for said in ("adopted from a localized photograph, within 0.02 m (95 %)", "50 % of its matches", "r0 ", ", r1 "):
        assert said in shown
    tomorrow = datetime.now(timezone.utc) + timedelta(days=1)
    assert "0 adopted" in run("reference", "undo-adoption", scene, "--since", f"{tomorrow:%Y-%m-%d}", "--yes")[1]
    assert "1 adopted" in run("reference", "undo-adoption", scene, "--since", "2026-01-01", "--yes")[1]
    code, _, error = run("reference", "undo-adoption", scene, "--since", "monday")
    assert (code, "is no time such as" in error) == (2, True)


def test_retired_references_are_shown_and_restored(run: Run, server: RunningServer, client: Client, scene: str) -> None:
    store = server.engine.references.retrievals[0].indexes._store
    keys = store.find_keys(SceneKey(scene), ["r1"])
    adoption.retire(store, SceneKey(scene), [keys["r1"]], RetirementReason.CONTRADICTED)
    _, text, _ = run("reference", "list", scene, "--retired")
    assert "do not show what it shows" in text
    assert "retired on" not in text + (shown := run("reference", "show", scene, "r1")[1])
    assert "UTC: photographs from about its viewpoint do not show" in shown
    assert run("reference", "restore", scene, "r1") == (0, "r1 is chosen for photographs again\n", "")
    assert run("reference", "restore", scene, "r1") == (0, "r1 was not retired\n", "")
    assert list(client.list_references(scene, only_retired=True)) == []


def test_a_reference_is_retired_and_restored_by_command(run: Run, client: Client, scene: str) -> None:
    for it in ("r0", "r1"):
        assert run("reference", "retire", scene, it) == (0, f"{it} is not chosen for photographs any more\n", "")
    assert "by request" in run("reference", "list", scene, "--retired")[1]
    code, text, _ = run("reference", "restore", scene, "--place", "r1", "--since", "2026-01-01")
    forgotten = "what photographs said of places that needed a new survey is forgotten"
    assert (code, text.splitlines()) == (0, ["1 reference chosen for photographs again", "  r1", forgotten])
    assert "1 reference" in (text := run("reference", "restore", scene, "--all")[1])
    assert forgotten in text
    assert list(client.list_references(scene, only_retired=True)) == []


def test_references_that_stay_retired_are_named_with_why(run: Run, client: Client, scene: str) -> None:
    client.add_reference(scene, NewReference("new", PHOTO, CAMERA, pose(5.0), provenance=ADOPTED))
    run("reference", "retire", scene, "r0")  # which vouches for more than half
    later = datetime.now(timezone.utc)
    for it in ("r2", "new"):
        run("reference", "retire", scene, it)
    code, text, _ = run("reference", "restore", scene, "--since", later.isoformat())
    lines = ["1 reference chosen for photographs again", "  r2", "1 reference still retired"]
    assert (code, text.splitlines()) == (0, [*lines, "  new: what vouches for it was deleted or is retired"])
    assert client.restore_references(scene) == RestoredReferences(("new", "r0"), {})


def test_a_place_is_that_of_a_surveyed_reference(run: Run, client: Client, scene: str) -> None:
    client.add_reference(scene, NewReference("adopted-1", PHOTO, CAMERA, pose(5.0), provenance=ADOPTED))
    run("reference", "retire", scene, "adopted-1")
    assert "adopted-1" not in run("reference", "list", scene, "--places")[1]
    code, _, error = run("reference", "restore", scene, "--place", "adopted-1")
    assert (code, "was adopted: name the surveyed reference of its place" in error) == (1, True)


def test_undoing_nothing_requires_the_role_all_the_same(tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    token = {role: create_token(tokens, role, "default", role, None) for role in ("write", "localize")}
    with serving(tmp_path / "data", tokens_file=tokens) as server:
        with Client(server.address, ConnectOptions(token=token["write"])) as client:
            client.create_scene("hall")
            assert client.undo_adoption("hall", datetime(2026, 1, 1, tzinfo=timezone.utc)) == []
        with Client(server.address, ConnectOptions(token=token["localize"])) as client:
            with pytest.raises(PermissionDenied) as caught:
                client.undo_adoption("hall", datetime(2026, 1, 1, tzinfo=timezone.utc))
            assert caught.value.reason == "ROLE_TOO_LOW"


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("", "which ones? Give a REFERENCE, or --place"),
        ("r1 --all", "REFERENCE does not go together with --all"),
        ("--place r1 --all", "--all does not go together with --place"),
        ("--since 2026-01-01 --all", "--all does not go together with --since"),
        ("r1 --place r1 --since 2026-01-01", "REFERENCE does not go together with --place and --since"),
        ("--since 20260101", "'20260101' is no time such as"),
    ],
)
def test_flags_that_contradict_each_other_are_named(run: Run, scene: str, flags: str, said: str) -> None:
    code, _, error = run("reference", "restore", scene, *flags.split())
    assert (code, said in error) == (2, True)


def test_an_arbitrary_unit_has_no_default_radius(run: Run, client: Client, scene: str) -> None:
    client.update_scene(scene, arbitrary_unit=True)
    code, _, error = run("scene", "update", scene, "--adopt")
    assert (code, "the scene's unit is arbitrary" in error) == (2, True)
    code, text, error = run("scene", "update", scene, "--adopt", "--adopt-radius", "0.2")
    assert (code, "within 0.2 units (68 %)" in text) == (0, True)
    assert "deleted 24 h after it was adopted" in error
    assert "within 0.2 units (68 %)" in run("scene", "get", scene)[1]
    code, _, error = run("scene", "update", scene, "--adopt", "--unit", "metre")
    assert (code, "the scene's unit is the metre: give" in error) == (2, True)
    code, _, error = run("scene", "create", "units", "--unit", "arbitrary", "--adopt")
    assert (code, "the scene's unit is arbitrary" in error) == (2, True)


def test_places_with_the_least_survey_left_come_first(run: Run, server: RunningServer, scene: str) -> None:
    store = server.engine.references.retrievals[0].indexes._store
    keys = store.find_keys(SceneKey(scene), ["r0", "r2"])
    shares = {keys["r0"]: 0.9, keys["r2"]: 0.2}
    adoption.change_standings(
        store.database, keys.values(), lambda key, it: replace(it, surveyed_share=shares[key], photograph_count=7)
    )
    run("reference", "retire", scene, "r1")  # photographs said nothing of it
    _, text, _ = run("reference", "list", scene, "--places")
    assert [line.split() for line in text.splitlines()[1:]] == [
        ["r2", "20", "%", "7", "0"],
        ["r0", "90", "%", "7", "0"],
    ]
