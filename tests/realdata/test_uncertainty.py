"""Reported radii on real photographs with known poses hold about as often as they state."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.special import bdtrik

from mapless_server.method.answer import Localization
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.uncertainty.radii import accuracy_from_covariance
from mapless_tools.dataset import Dataset
from research.places import answered, right_pairs

from .conftest import read_place_once

pytestmark = pytest.mark.realdata


def fewest(probability: float, count: int, share: float) -> float:
    """The number that is not exceeded with a probability, of so many each of which holds with a share."""
    return float(np.ceil(bdtrik(probability, count, share)))


def held(scene: str, k: int) -> tuple[int, dict[str, int]]:
    """Answers of a scene's photographs, each left out once and given K references, and how many radii held."""
    found = list(answered(right_pairs(read_place_once(scene), None, (k,)), LocalizeOptions(coverage=1.0)))
    rows: list[Sequence[bool]] = []
    for it in found:
        assert isinstance(it.answer.outcome, Localization)
        assert it.answer.outcome.covariance is not None
        assert it.off is not None
        radii, (off_m, off_deg) = accuracy_from_covariance(it.answer.outcome.covariance), it.off
        rows.append(
            (
                off_m <= radii.position_68_m,
                off_m <= radii.position_95_m,
                off_deg <= radii.rotation_68_deg,
                off_deg <= radii.rotation_95_deg,
            )
        )
    names = ("position 68", "position 95", "rotation 68", "rotation 95")
    return len(rows), dict(zip(names, np.sum(rows, axis=0).tolist(), strict=True))


@pytest.mark.parametrize(
    ("scene", "k"), [("fountain-P11", 5), pytest.param("tum-fr3-office", 10, marks=pytest.mark.nightly)]
)
def test_radii_contain_the_truth_as_often_as_stated(photographs: Callable[[str], Dataset], scene: str, k: int) -> None:
    """Within what chance allows one time in a thousand; photographs of one walk are not independent, besides."""
    photographs(scene)
    count, shares = held(scene, k)
    assert count >= 11
    low, high = fewest(0.0005, count, 0.68), fewest(0.9995, count, 0.68)
    for name in ("position 68", "rotation 68"):
        assert low <= shares[name] <= high, (name, shares, count)
    for name in ("position 95", "rotation 95"):
        assert shares[name] >= fewest(0.0005, count, 0.95), (name, shares, count)
