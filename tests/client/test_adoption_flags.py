"""The flags of the command by which a scene adopts."""

import pytest

from mapless import AdoptionPolicy
from mapless.cli.adoption import policy_of, policy_text
from mapless.cli.arguments import make_parser


def given(flags: str, current: AdoptionPolicy | None = None) -> AdoptionPolicy | None:
    return policy_of(make_parser().parse_args(["scene", "update", "office", *flags.split()]), current)


def test_values_not_given_stay_as_the_scene_has_them() -> None:
    assert given("--adopt --adopt-radius 0.1") == AdoptionPolicy(max_radius_m=0.1)
    current = AdoptionPolicy(most_per_place=8, min_trust=0.7)
    assert given("--adopt --adopt-radius 0.1", current) == AdoptionPolicy(8, 0.7, 0.1)
    assert given("--adopt", current) == current


@pytest.mark.parametrize("flags", ["--adopt-most 8", "--adopt-radius 0.1", "--adopt-trust 0", "--adopt-surveyed 0.5"])
def test_a_value_alone_does_not_switch_adoption_on(flags: str) -> None:
    with pytest.raises(ValueError, match="need --adopt"):
        given(flags)


def test_the_radius_has_the_scenes_unit() -> None:
    assert "within 0.03 units (68 %)" in str(policy_text(AdoptionPolicy(), "units"))
