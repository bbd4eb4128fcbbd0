"""The audit reports a planted fault with its kind and size, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from support.audits import audit_references, finder_of
from support.scenes import SceneOptions, SyntheticScene, look_at, make_scene

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.method.features.views import Features, PosedView
from mapless_server.method.judge import judge
from mapless_server.scenes import AuditVerdict, Coverage, CoverageVerdict, ReferenceAudit
from mapless_server.scenes.audit.coverage import REPEATABILITY, check_coverage
from mapless_server.scenes.audit.neighbourhood import PairMatches
from mapless_server.scenes.audit.resection import with_focal

SCENE = SceneOptions(point_count=250, reference_count=6, baseline_m=0.4, noise_px=0.3, distractor_count=40)
VICTIM = 2


@pytest.fixture(scope="module")
def references() -> list[PosedView]:
    return list(make_scene(np.random.default_rng(7), SCENE).references)


@pytest.fixture(scope="module")
def pairs() -> PairMatches:
    """Shared, because matches depend on the photographs alone and no test alters these under the same key."""
    return PairMatches()


def audit(references: list[PosedView], pairs: PairMatches) -> list[ReferenceAudit]:
    return audit_references([r.name for r in references], finder_of(references), pairs=pairs)


def altered(references: list[PosedView], index: int, reference: PosedView) -> list[PosedView]:
    return [reference if i == index else r for i, r in enumerate(references)]


def moved(reference: PosedView, by_m: tuple[float, float, float]) -> PosedView:
    pose = reference.world_from_camera
    return replace(reference, world_from_camera=RigidTransform(pose.rotation, pose.translation + by_m))


def only_fault(audits: list[ReferenceAudit], index: int) -> ReferenceAudit:
    """The audit of the only reference that is not consistent."""
    assert [a.verdict for i, a in enumerate(audits) if i != index] == [AuditVerdict.CONSISTENT] * (len(audits) - 1)
    return audits[index]


def test_nothing_is_found_where_nothing_is_wrong(references: list[PosedView], pairs: PairMatches) -> None:
    audits = audit(references, pairs)
    assert {a.verdict for a in audits} == {AuditVerdict.CONSISTENT}
    assert max(a.position_offset_m or 0 for a in audits) < 0.01
    assert max(a.error_px or 0 for a in audits) < 1.0


@pytest.mark.parametrize("by_m", [(0.05, 0.0, 0.0), (0.0, 0.0, -0.05), (0.4, -0.3, 0.2)])
def test_a_moved_pose_is_named_with_its_distance(
    references: list[PosedView], pairs: PairMatches, by_m: tuple[float, float, float]
) -> None:
    found = only_fault(audit(altered(references, VICTIM, moved(references[VICTIM], by_m)), pairs), VICTIM)
    assert found.verdict is AuditVerdict.WRONG_POSE
    assert found.position_offset_m == pytest.approx(np.linalg.norm(by_m), abs=0.01)
    assert found.rotation_offset_deg is not None
    assert found.rotation_offset_deg < 0.2


@pytest.mark.parametrize("axis", [(0.6, 0.8, 0.0), (0.0, 0.0, 1.0)])
def test_a_turned_pose_is_named_with_its_angle(
    references: list[PosedView], pairs: PairMatches, axis: tuple[float, float, float]
) -> None:
    pose = references[VICTIM].world_from_camera
    turned = RigidTransform(rotation_from_vector(np.radians(2) * np.array(axis)) @ pose.rotation, pose.translation)
    victim = replace(references[VICTIM], world_from_camera=turned)
    found = only_fault(audit(altered(references, VICTIM, victim), pairs), VICTIM)
    assert found.verdict is AuditVerdict.WRONG_POSE
    assert found.rotation_offset_deg == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("ratio", [0.95, 1.05])
def test_a_wrong_focal_length_is_named_with_what_puts_it_right(
    references: list[PosedView], pairs: PairMatches, ratio: float
) -> None:
    view = references[VICTIM].view
    victim = replace(references[VICTIM], view=replace(view, camera=with_focal(view.camera, ratio)))
    found = only_fault(audit(altered(references, VICTIM, victim), pairs), VICTIM)
    assert found.verdict is AuditVerdict.WRONG_INTRINSICS
    assert found.focal_ratio == pytest.approx(1 / ratio, abs=0.005)
    assert f"{100 * (ratio - 1):+.1f} %" in found.message


def test_a_focal_length_off_by_less_than_two_per_cent_is_not_named(
    references: list[PosedView], pairs: PairMatches
) -> None:
    view = references[VICTIM].view
    victim = replace(references[VICTIM], view=replace(view, camera=with_focal(view.camera, 1.015)))
    assert not any(a.verdict.is_alarm for a in audit(altered(references, VICTIM, victim), pairs))


def test_a_pose_that_looks_away_has_no_error_in_pixels(references: list[PosedView], pairs: PairMatches) -> None:
    pose = references[VICTIM].world_from_camera
    away = RigidTransform(pose.rotation @ np.diag([-1.0, 1.0, -1.0]), pose.translation)
    victim = replace(references[VICTIM], world_from_camera=away)
    found = only_fault(audit(altered(references, VICTIM, victim), pairs), VICTIM)
    assert (found.verdict, found.error_px) == (AuditVerdict.WRONG_POSE, None)


def test_a_pose_that_no_answer_would_have_accuses_nothing(
    references: list[PosedView], pairs: PairMatches, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(judge, "MAX_RADIUS_SHARE", 1e-9)
    scene = altered(references, VICTIM, moved(references[VICTIM], (0.4, -0.3, 0.2)))
    found = only_fault(audit(scene, pairs), VICTIM)
    assert found.verdict is AuditVerdict.UNVERIFIABLE
    assert found.message.startswith("contradicted, too weakly to say that it is wrong: another camera fits, but")
    assert found.position_offset_m == pytest.approx(np.linalg.norm((0.4, -0.3, 0.2)), abs=0.01)


def test_a_wrong_pose_and_focal_length_are_both_named(references: list[PosedView], pairs: PairMatches) -> None:
    view = references[VICTIM].view
    victim = replace(
        moved(references[VICTIM], (0.0, 0.3, 0.0)), view=replace(view, camera=with_focal(view.camera, 1.1))
    )
    found = only_fault(audit(altered(references, VICTIM, victim), pairs), VICTIM)
    assert found.verdict is AuditVerdict.WRONG_POSE_AND_INTRINSICS
    assert found.position_offset_m == pytest.approx(0.3, abs=0.03)
    assert found.focal_ratio == pytest.approx(1 / 1.1, abs=0.01)


def test_swapped_photographs_name_each_other(references: list[PosedView], pairs: PairMatches) -> None:
    a, b = references[1], references[4]
    swapped = altered(references, 1, replace(a, view=b.view, key=b.key))
    swapped = altered(swapped, 4, replace(b, view=a.view, key=a.key))
    audits = audit(swapped, pairs)
    assert [x.verdict for i, x in enumerate(audits) if i not in (1, 4)] == [AuditVerdict.CONSISTENT] * 4
    assert (audits[1].verdict, audits[1].other) == (AuditVerdict.SWAPPED_IMAGE, b.name)
    assert (audits[4].verdict, audits[4].other) == (AuditVerdict.SWAPPED_IMAGE, a.name)


def test_a_photograph_stored_twice_is_a_duplicate(references: list[PosedView], pairs: PairMatches) -> None:
    copy = replace(references[VICTIM], key="copy", name="scenes/synthetic/references/copy")
    audits = audit([*references, copy], pairs)
    assert [a.verdict.is_alarm for a in audits] == [False] * 7
    assert (audits[VICTIM].verdict, audits[VICTIM].other) == (AuditVerdict.DUPLICATE, copy.name)
    assert (audits[6].verdict, audits[6].other) == (AuditVerdict.DUPLICATE, references[VICTIM].name)


def test_a_copy_at_a_wrong_pose_bears_no_witness(references: list[PosedView], pairs: PairMatches) -> None:
    """Two copies at the same wrong pose would confirm each other."""
    wrong = moved(references[VICTIM], (0.1, 0.0, 0.0))
    copy = replace(wrong, key="copy", name="scenes/synthetic/references/copy")
    audits = audit([*altered(references, VICTIM, wrong), copy], pairs)
    assert [a.verdict.is_alarm for a in audits] == [i in (VICTIM, 6) for i in range(7)]
    assert (audits[6].verdict, audits[6].other) == (AuditVerdict.WRONG_POSE, wrong.name)
    assert audits[6].position_offset_m == pytest.approx(0.1, abs=0.01)


def test_a_photograph_half_changed_means_a_changed_scene(references: list[PosedView]) -> None:
    random = np.random.default_rng(1)
    features = references[VICTIM].view.features
    left = features.keypoints[:, 0] < references[VICTIM].view.camera.width_px / 2
    strange = random.standard_normal(features.descriptors.shape).astype(np.float32)
    strange /= np.linalg.norm(strange, axis=1, keepdims=True)
    descriptors = np.where(left[:, None], strange, features.descriptors)
    view = replace(references[VICTIM].view, features=Features(features.keypoints, descriptors, features.sizes_px))
    victim = replace(references[VICTIM], key="changed", view=view)
    found = only_fault(audit(altered(references, VICTIM, victim), PairMatches()), VICTIM)
    assert found.verdict is AuditVerdict.SCENE_CHANGED
    assert found.changed_share is not None
    assert 0.35 < found.changed_share < 0.65


def test_a_reference_without_neighbours_is_unverifiable(references: list[PosedView], pairs: PairMatches) -> None:
    elsewhere = make_scene(np.random.default_rng(99), replace(SCENE, reference_count=2)).references[0]
    alone = moved(replace(elsewhere, key="alone", name="scenes/synthetic/references/alone"), (50.0, 0.0, 0.0))
    audits = audit([*references, alone], pairs)
    assert [a.verdict for a in audits] == [AuditVerdict.CONSISTENT] * 6 + [AuditVerdict.UNVERIFIABLE]
    assert not audits[-1].verdict.is_alarm
    assert audits[-1].position_offset_m is None


def test_one_reference_alone_is_unverifiable(references: list[PosedView], pairs: PairMatches) -> None:
    assert [a.verdict for a in audit(references[:1], pairs)] == [AuditVerdict.UNVERIFIABLE]


def test_the_verdict_does_not_depend_on_other_references(references: list[PosedView], pairs: PairMatches) -> None:
    scene = altered(references, VICTIM, moved(references[VICTIM], (0.05, 0.0, 0.0)))
    together = audit(scene, pairs)
    neighbour = VICTIM + 1
    alone = audit_references([scene[neighbour].name], finder_of(scene), pairs=pairs)
    assert alone == [together[neighbour]]


def test_one_among_many_faulty_ones_is_never_consistent(references: list[PosedView], pairs: PairMatches) -> None:
    """Every second pose is wrong by as much: which ones are right is not decidable."""
    many = [moved(r, (0.1 * (i - 2), 0.15, 0.0)) if i % 2 else r for i, r in enumerate(references)]
    audits = audit(many, pairs)
    assert all(a.verdict is not AuditVerdict.CONSISTENT for i, a in enumerate(audits) if i % 2)
    assert all((a.error_px or 0) < 3 for a in audits if a.verdict is AuditVerdict.CONSISTENT)


# Coverage

PAIRS_OF_SCENE = PairMatches()


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return make_scene(np.random.default_rng(3), SceneOptions(reference_count=6, noise_px=0.3))


def check(scene: SyntheticScene, world_from_camera: RigidTransform) -> Coverage:
    return check_coverage(scene.query.camera, world_from_camera, finder_of(scene.references), PAIRS_OF_SCENE)


def test_among_the_references_one_is_localized(scene: SyntheticScene) -> None:
    coverage = check(scene, scene.world_from_query)
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
    scene: SyntheticScene, centre: tuple[float, float, float], target: tuple[float, float, float]
) -> None:
    coverage = check(scene, look_at(centre, target))
    assert coverage.verdict is CoverageVerdict.NOT_LOCALIZABLE
    assert coverage.expected_match_count < 20
    assert coverage.position_68_m is None


def test_the_further_off_the_fewer_matches(scene: SyntheticScene) -> None:
    poses = [look_at((0.0, 0.0, -distance), (0.0, 0.0, 0.0)) for distance in (4.0, 6.0, 9.0, 14.0)]
    counts = [check(scene, pose).expected_match_count for pose in poses]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > 4 * counts[-1]


def test_without_two_references_nothing_is_known(scene: SyntheticScene) -> None:
    for references in ((), scene.references[:1]):
        finder = finder_of(references)
        coverage = check_coverage(scene.query.camera, scene.world_from_query, finder, PAIRS_OF_SCENE)
        assert coverage.verdict is CoverageVerdict.NOT_LOCALIZABLE
        assert "at least 2" in coverage.message
