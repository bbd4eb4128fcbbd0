"""A server with two tiers: what is stored, what is computed, and what an answer reports."""

from pathlib import Path

import pytest
from support.servers import CAMERA, PHOTO, make_scene, serving

from mapless import Client

STAGES = ["decode", "features", "coarse", "pnp"]


@pytest.mark.parametrize(
    ("trust", "answered", "stages"),
    [(0.9, "cheap", STAGES), (0.01, "strong", [*STAGES, *(f"strong/{it}" for it in ("features", "coarse", "pnp"))])],
    ids=["sure", "doubtful"],
)
def test_an_answer_names_its_features_and_the_time_of_all(
    tmp_path: Path, trust: float, answered: str, stages: list[str]
) -> None:
    with serving(tmp_path, ("cheap", "strong")) as server, Client(server.address) as client:
        make_scene(client, "s", 2)
        assert [len(it.seen) for it in server.extractors] == [2, 2], "each tier sees each reference when it is added"
        server.method.trust = trust
        used = client.localize(PHOTO, CAMERA, "s", ["r0", "r1"]).diagnostics
    assert (used.features, list(used.stage_s)) == (answered, stages)


def test_a_server_of_other_features_takes_over_the_store(tmp_path: Path) -> None:
    """Each reference is described when it is first needed, once, and the scene does not change by it."""
    with serving(tmp_path, ("old",)) as server, Client(server.address) as client:
        make_scene(client, "s", 3)
        generation = client.get_scene("s").generation
    for described in (3, 0):  # one server, and then the same again
        with serving(tmp_path, ("new",)) as server, Client(server.address) as client:
            answers = [client.localize(PHOTO, CAMERA, "s") for _ in range(2)]
            assert [it.diagnostics.features for it in answers] == ["new", "new"]
            assert ["describe" in it.diagnostics.stage_s for it in answers] == [described > 0, False]
            assert len(server.extractors[0].seen) == described + len(answers)
            assert {it.diagnostics.store_generation for it in answers} == {generation}
