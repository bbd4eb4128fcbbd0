"""Coverage predicts many matches among the references, none away from them."""

import numpy as np
import pytest
from support.audits import finder_of
from support.scenes import SceneOptions, SyntheticScene, look_at, make_scene

from mapless.geometry import RigidTransform
from mapless_server.scenes import Coverage, CoverageVerdict
from mapless_server.scenes.audit.coverage import REPEATABILITY, check_coverage
from mapless_server.scenes.audit.neighbourhood import PairMatches


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return make_scene(np.random.default_rng(3), SceneOptions(reference_count=6, noise_px=0.3))


@pytest.fixture(scope="module")
def pairs() -> PairMatches:
    return PairMatches()


def check(scene: SyntheticScene, pairs: PairMatches, world_from_camera: RigidTransform) -> Coverage:
    return check_coverage(scene.query.camera, world_from_camera, finder_of(scene.references), pairs)


def test_among_the_references_one_is_localized(scene: SyntheticScene, pairs: PairMatches) -> None:
    coverage = check(scene, pairs, scene.world_from_query)
    assert coverage.verdict is CoverageVerdict.LOCALIZABLE
    assert 150 < coverage.expected_match_count <= REPEATABILITY * len(scene.x_in_world)
    assert coverage.image_share > 0.3
    assert coverage.position_68_m is not None
    assert 0 < coverage.position_68_m < 0.02
    assert set(coverage.references) <= {r.name for r in scene.references}
    assert len(coverage.references) >= 2


@pytest.mark.parametrize(
    ("centre", "target"),
    [
        ((0.0, 0.0, -4.0), (0.0, 0.0, -20.0)),  # where the references stand, looking away
        ((0.0, 0.0, 4.0), (0.0, 0.0, 0.0)),  # at the same things from behind
        ((0.0, 0.0, -24.0), (0.0, 0.0, 0.0)),  # the same way from 20 m further off
        ((20.0, 0.0, -4.0), (20.0, 0.0, 0.0)),  # 20 m aside
    ],
)
def test_where_no_reference_looks_one_is_not_localized(
    scene: SyntheticScene, pairs: PairMatches, centre: tuple[float, float, float], target: tuple[float, float, float]
) -> None:
    coverage = check(scene, pairs, look_at(centre, target))
    assert coverage.verdict is CoverageVerdict.NOT_LOCALIZABLE
    assert coverage.expected_match_count < 20
    assert coverage.position_68_m is None


def test_the_further_off_the_fewer_matches(scene: SyntheticScene, pairs: PairMatches) -> None:
    poses = [look_at((0.0, 0.0, -distance), (0.0, 0.0, 0.0)) for distance in (4.0, 6.0, 9.0, 14.0)]
    counts = [check(scene, pairs, pose).expected_match_count for pose in poses]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > 4 * counts[-1]


def test_without_two_references_nothing_is_known(scene: SyntheticScene, pairs: PairMatches) -> None:
    for references in ((), scene.references[:1]):
        finder = finder_of(references)
        coverage = check_coverage(scene.query.camera, scene.world_from_query, finder, pairs)
        assert coverage.verdict is CoverageVerdict.NOT_LOCALIZABLE
        assert "at least 2" in coverage.message
