"""No input breaks a law of a fuzz target: a short guided campaign of each, and random mutations without guidance.

The long campaign is `make fuzz`. What either finds becomes a test of its own (`test_findings.py`).
"""

import importlib.util
from pathlib import Path

import pytest

from fuzz import campaign, plain
from fuzz.target import TARGETS, load

RUNS = 1000
PLAIN_RUNS = 150
SEED = 20261121
LIMIT_S = 150.0
needs_atheris = pytest.mark.skipif(
    importlib.util.find_spec("atheris") is None, reason="atheris has no wheel for this interpreter or machine"
)


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_are_accepted_and_their_mutations_break_no_law(name: str) -> None:
    target = load(name)
    seeds = list(target.seeds())
    accepted = [target.check(seed) for seed in seeds]
    # Some begin with what must be refused: a token that has expired, one of a list that is not asked here.
    assert sum(accepted) >= 0.5 * len(seeds)
    made = plain.inputs(target, PLAIN_RUNS, SEED)[len(seeds) :]
    outcomes = {target.check(data) for data in made}
    assert outcomes == {True, False}  # else the mutations change nothing, or nothing is left of what is right
    assert all(len(data) <= target.max_bytes for data in (*seeds, *made))


@needs_atheris
@pytest.mark.nightly
@pytest.mark.parametrize("name", TARGETS)
def test_a_short_campaign_finds_nothing(name: str, tmp_path: Path) -> None:
    outcome = campaign.fuzz(name, tmp_path, RUNS, SEED, LIMIT_S)
    log = (tmp_path / name / "log").read_text(errors="replace")
    assert outcome.findings == (), log[-3000:]
    assert outcome.exit_code == 0, log[-3000:]
    assert RUNS <= outcome.inputs < 1.1 * RUNS  # libFuzzer runs some twice
    assert outcome.accepted > 0
    assert outcome.edges > len(load(name).seeds())  # it is guided


@needs_atheris
def test_a_finding_ends_the_campaign_and_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A target whose law every input breaks: the input that it broke on is there to be tried again."""
    folder = tmp_path / "fuzz"
    folder.mkdir()
    for file in Path(campaign.__file__).parent.glob("*.py"):
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / "images.py").write_text(
        "from .target import Target\n"
        "def check(data):\n    assert b'bad' not in data, 'a law'\n    return True\n"
        "TARGET = Target(lambda: [b'good', b'this is bad'], check, lambda data, random, mutate: mutate(data))\n"
    )
    monkeypatch.setattr(campaign, "ROOT", tmp_path)
    outcome = campaign.fuzz("images", tmp_path / "output", RUNS, SEED, LIMIT_S)
    (finding,) = outcome.findings
    assert Path(finding).read_bytes() == b"this is bad"
    assert outcome.exit_code != 0
    assert "AssertionError: a law" in (tmp_path / "output" / "images" / "log").read_text()
    assert "| image decoding | images |" in campaign.table([outcome])
