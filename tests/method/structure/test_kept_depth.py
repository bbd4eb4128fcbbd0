"""Depths kept with references: where they put points, what triangulation says of them, what they gain."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import SceneOptions, make_scene, random_for

from mapless.geometry import Array
from mapless_server.method.bundle.bundle import free_problem
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.features.views import DepthSource, Features, KeptDepth, KeypointDepths, PosedView
from mapless_server.method.judge.answer import Localization
from mapless_server.method.judge.hypothesis import Solver
from mapless_server.method.localize import attempts, localize
from mapless_server.method.options import DoubtOptions, LocalizeOptions, StageContext, Variant
from mapless_server.method.pairs.correspond import Correspondences, Matcher
from mapless_server.method.pipeline import Coarse, Pipeline, Prepared, prepare, reconstruct
from mapless_server.method.structure.kept_depth import PLACED_REGIONS, with_kept_depths
from mapless_server.method.structure.model import ScaleSource, Structure
from mapless_server.method.structure.structure import StructureOptions, triangulated_structure

SCENE = make_scene(random_for("kept depth"), SceneOptions(point_count=500, reference_count=3, baseline_m=0.8))
SIGMA = 0.02
ALWAYS = 0.0
"""Share of points at depths to add: also where many triangulated points are matched."""


def true_depth(index: int) -> Array:
    """(N,) at the keypoints of a reference; NaN where they show no point."""
    points, pose = SCENE.reference_points[index], SCENE.references[index].world_from_camera
    depth = pose.inverse().apply(SCENE.x_in_world[points])[:, 2]
    return np.where(points >= 0, depth, np.nan)


def keypoint_depths(depth: NDArray[np.floating], sigma: float) -> KeypointDepths:
    """Depths of a network, which share a factor as wrong as each of them is."""
    return KeypointDepths(depth.astype(np.float32), np.full(len(depth), sigma, np.float32), sigma)


def with_depths(
    index: int, noise: float = SIGMA, seed: int = 0, factor: float = 1.0, source: DepthSource = DepthSource.NETWORK
) -> PosedView:
    """A reference with its true depths, each with an error."""
    depth = true_depth(index)
    error = np.random.default_rng(seed).normal(0.0, noise, len(depth)) if noise else 0.0
    depths = keypoint_depths(factor * depth * np.exp(error), max(noise, 1e-3))
    return replace(SCENE.references[index], depths=replace(depths, source=source))


def matched(references: tuple[PosedView, ...]) -> tuple[Structure, Correspondences]:
    correspondences = Matcher().correspond(SCENE.query, references)
    return triangulated_structure(references, correspondences, StructureOptions()), correspondences


def point_numbers(structure: Structure, references: tuple[PosedView, ...]) -> Array:
    """The scene's point that each point of a structure is, by its first observation; -1 for none."""
    tracks, index = structure.tracks, [SCENE.references.index(replace_depths(it)) for it in references]
    first = tracks.starts
    views, keypoints = tracks.view[first], tracks.keypoint[first]
    return np.array([SCENE.reference_points[index[v]][k] for v, k in zip(views, keypoints, strict=True)])


def replace_depths(reference: PosedView) -> PosedView:
    return next(it for it in SCENE.references if it.key == reference.key)


def test_a_keypoint_that_only_the_query_matches_gets_a_point() -> None:
    references = (with_depths(0, noise=0.0),)
    nothing = np.empty(0, np.intp)
    structure = Structure(np.empty((0, 3)), Tracks(nothing, nothing, nothing), StructureOptions().first_noise)
    correspondences = Matcher().correspond(SCENE.query, references)
    found = with_kept_depths(structure, references, correspondences, ALWAYS)
    assert len(found.x_in_world) > 200
    assert not found.triangulated.any()
    numbers = point_numbers(found, references)
    off = np.linalg.norm(found.x_in_world - SCENE.x_in_world[numbers], axis=1)
    assert np.quantile(off, 0.99) < 0.02, "half a pixel at four metres is a few millimetres"


def test_triangulated_points_come_before_single_ones() -> None:
    references = tuple(with_depths(i) for i in range(3))
    structure, correspondences = matched(references)
    found = with_kept_depths(structure, references, correspondences, ALWAYS)
    count = len(structure.x_in_world)
    assert found.triangulated[:count].all()
    assert not found.triangulated[count:].any()
    single = found.tracks.select(~found.triangulated)
    of_query = [set(it[:, 1].tolist()) for it in correspondences.query_matches]
    assert all(k in of_query[v] for v, k in zip(single.view, single.keypoint, strict=True))
    pairs = list(zip(found.tracks.view.tolist(), found.tracks.keypoint.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs), "no keypoint observes two points"


@pytest.mark.parametrize("factor", [0.95, 1.0, 1.05])
def test_a_factor_common_to_all_depths_is_removed(factor: float) -> None:
    """Triangulated points say what it is, though a tenth of the depths is wrong; they stay where they are."""
    reference = with_depths(0, noise=0.005, factor=factor)
    assert reference.depths is not None
    depth = reference.depths.depth.copy()
    depth[::10] *= 1.5
    references = (replace(reference, depths=keypoint_depths(depth, SIGMA)), *SCENE.references[1:])
    structure, correspondences = matched(references)
    kept = structure.tracks.select(np.arange(len(structure.x_in_world)) % 2 == 0)
    half = replace(structure, x_in_world=structure.x_in_world[::2], tracks=kept)
    found = with_kept_depths(half, references, correspondences, ALWAYS)
    count = len(half.x_in_world)
    np.testing.assert_array_equal(found.x_in_world[:count], half.x_in_world)
    pose, numbers = references[0].world_from_camera.inverse(), point_numbers(found, references)[count:]
    known = numbers >= 0
    ratio = pose.apply(found.x_in_world[count:][known])[:, 2] / pose.apply(SCENE.x_in_world[numbers[known]])[:, 2]
    assert known.sum() > 50
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("offset_m", [-0.06, 0.04])
def test_an_offset_common_to_all_depths_is_removed(offset_m: float) -> None:
    """Every other point is triangulated: the others' depths, near and far ones, have the offset of these."""
    reference = with_depths(0, noise=0.003)
    assert reference.depths is not None
    biased = keypoint_depths(reference.depths.depth + offset_m, SIGMA)
    references = (replace(reference, depths=biased), *SCENE.references[1:])
    structure, correspondences = matched(references)
    kept = structure.tracks.select(np.arange(len(structure.x_in_world)) % 2 == 0)
    half = replace(structure, x_in_world=structure.x_in_world[::2], tracks=kept)
    found = with_kept_depths(half, references, correspondences, ALWAYS)
    single = len(half.x_in_world)
    pose, numbers = references[0].world_from_camera.inverse(), point_numbers(found, references)[single:]
    true = pose.apply(SCENE.x_in_world[numbers])[:, 2]
    off = pose.apply(found.x_in_world[single:])[:, 2] - true
    for some in (true < np.quantile(true, 0.3), true > np.quantile(true, 0.7)):
        assert abs(np.median(off[some & (numbers >= 0)])) < abs(offset_m) / 4


def test_a_triangulated_point_lies_near_the_plane_of_its_depth() -> None:
    """But not if the depth is half as long again, as behind an edge."""
    reference = with_depths(0, noise=0.005)
    assert reference.depths is not None
    depth = reference.depths.depth.copy()
    depth[::10] *= 1.5
    references = (replace(reference, depths=keypoint_depths(depth, SIGMA)), *SCENE.references[1:])
    structure, correspondences = matched(references)
    found = with_kept_depths(structure, references, correspondences, ALWAYS)
    assert found.planes is not None
    known = np.flatnonzero(found.triangulated & (found.planes.information > 0))
    off = found.planes.distance(found.x_in_world)[known] * np.sqrt(found.planes.information[known])
    assert len(known) > 50
    assert np.abs(off).max() < 3
    wrong = found.tracks.point[(found.tracks.view == 0) & (found.tracks.keypoint % 10 == 0)]
    assert not found.planes.information[wrong[found.triangulated[wrong]]].any()


def test_depths_of_a_reference_weigh_as_so_many_regions() -> None:
    """Hundreds of exact depths are worth no more than regions with the common error each."""
    depth = true_depth(0)
    depths = KeypointDepths(depth.astype(np.float32), np.full(len(depth), 1e-3, np.float32), 0.02)
    references = (replace(SCENE.references[0], depths=depths),)
    nothing = np.empty(0, np.intp)
    structure = Structure(np.empty((0, 3)), Tracks(nothing, nothing, nothing), StructureOptions().first_noise)
    found = with_kept_depths(structure, references, Matcher().correspond(SCENE.query, references), ALWAYS)
    assert found.planes is not None
    depth = depth[found.tracks.keypoint]
    assert len(depth) > 200
    assert (found.planes.information * depth**2).sum() == pytest.approx(PLACED_REGIONS / 0.02**2, rel=0.05)


def test_depths_help_where_the_baseline_is_small() -> None:
    """Two references 4 cm apart, and photographs 0.8 m aside: triangulated points are uncertain along their rays."""
    options = SceneOptions(point_count=400, reference_count=2, baseline_m=0.04, query_offset_m=(0.8, -0.15, 0.3))
    errors = []
    for seed in range(12):
        scene = make_scene(random_for("small baseline", seed), options)
        random, given = np.random.default_rng(seed), list[PosedView]()
        for reference, seen in zip(scene.references, scene.reference_points, strict=True):
            depth = reference.world_from_camera.inverse().apply(scene.x_in_world[seen])[:, 2]
            noisy = np.where(seen >= 0, depth * random.normal(1, 0.005, len(depth)), np.nan)
            measured = replace(keypoint_depths(noisy, 0.005), source=DepthSource.MEASURED)
            given.append(replace(reference, depths=measured))
        for references in (scene.references, given):
            outcome = localize(scene.query, references, Pipeline(), LocalizeOptions()).outcome
            assert isinstance(outcome, Localization)
            errors.append(outcome.world_from_camera.translation - scene.world_from_query.translation)
    without, with_depth = np.moveaxis(np.array(errors).reshape(-1, 2, 3), 1, 0)
    assert (with_depth**2).mean() < (without**2).mean() / 9
    assert np.linalg.norm(with_depth, axis=1).max() < 0.007
    assert (np.abs(with_depth.mean(axis=0)) < 0.002).all(), "points are not nearer than they are"


def test_where_triangulated_points_suffice_depths_change_nothing() -> None:
    references = tuple(with_depths(i) for i in range(3))
    structure, correspondences = matched(references)
    assert with_kept_depths(structure, references, correspondences) is structure
    poses = [localize(SCENE.query, it, Pipeline(), LocalizeOptions()).outcome for it in (references, SCENE.references)]
    assert all(isinstance(it, Localization) for it in poses)
    first, second = (it.world_from_camera.matrix() for it in poses if isinstance(it, Localization))
    np.testing.assert_array_equal(first, second)


def test_measured_depths_are_used_beside_triangulated_points() -> None:
    references = tuple(with_depths(i) for i in range(3))
    measured = tuple(with_depths(i, source=DepthSource.MEASURED) for i in range(3))
    structure, correspondences = matched(measured)
    assert with_kept_depths(structure, references, correspondences) is structure
    assert not with_kept_depths(structure, measured, correspondences).triangulated.all()


def test_what_depths_share_is_in_the_covariance() -> None:
    """Every depth of two references is 5 % too long: the pose is off by as much as its covariance says of that."""
    answers = {}
    for factor in (1.0, 1.05):
        references = []
        for index in range(2):  # what only one of them shows
            kept = np.flatnonzero(SCENE.reference_points[index] % 2 == index)
            view = SCENE.references[index].view
            arrays = view.features.keypoints[kept], view.features.descriptors[kept], view.features.sizes_px[kept]
            depths = keypoint_depths((factor * true_depth(index))[kept], 0.002)
            depths = replace(depths, common_sigma=0.05, source=DepthSource.MEASURED)
            view = replace(view, features=Features(*arrays))
            references.append(replace(SCENE.references[index], view=view, depths=depths))
        outcome = localize(SCENE.query, references, Pipeline(), LocalizeOptions()).outcome
        assert isinstance(outcome, Localization)
        answers[factor] = outcome
    moved = answers[1.05].world_from_camera.translation - answers[1.0].world_from_camera.translation
    covariance = answers[1.05].covariance
    assert covariance is not None
    assert np.linalg.norm(moved) > 0.002
    sigma = np.sqrt(np.diag(covariance)[:3])
    assert np.linalg.norm(moved) < 2 * np.linalg.norm(sigma)
    assert np.linalg.norm(sigma) < 10 * np.linalg.norm(moved)


def test_planes_are_in_the_normal_equations_as_in_the_cost() -> None:
    references = tuple(with_depths(i) for i in range(3))
    structure, correspondences = matched(references)
    found = with_kept_depths(structure, references, correspondences, ALWAYS)
    chosen = np.arange(len(found.x_in_world))
    problem, start, _ = free_problem(found.tracks, references, found, chosen, 1e6)
    assert problem.by_view.planes is not None
    start = start.moved(np.zeros((3, 6)), np.random.default_rng(0).normal(0, 0.05, start.points.shape))
    equations, step = problem.linearize(problem.at(start)), 1e-6
    for point in (0, len(chosen) - 1):
        for axis in range(3):
            change = np.zeros((len(chosen), 3))
            change[point, axis] = step
            ahead, behind = (problem.cost(problem.at(start.moved(np.zeros((3, 6)), sign * change))) for sign in (1, -1))
            assert 2 * equations.point_gradient[axis, point] == pytest.approx((ahead - behind) / (2 * step), rel=1e-3)


def test_references_that_share_nothing_give_points_by_depth() -> None:
    """Without depths the pose is from matches with the references themselves, or there is none."""
    parts = []
    for index, reference in enumerate(SCENE.references):
        kept = np.flatnonzero(SCENE.reference_points[index] % 3 == index)
        view, depths = reference.view, with_depths(index).depths
        assert depths is not None
        arrays = view.features.keypoints[kept], view.features.descriptors[kept], view.features.sizes_px[kept]
        view = replace(view, features=Features(*arrays))
        parts.append(
            replace(
                reference,
                view=view,
                depths=keypoint_depths(depths.depth[kept], SIGMA),
            )
        )
    answers = {
        has_depths: localize(
            SCENE.query, [it if has_depths else replace(it, depths=None) for it in parts], Pipeline(), LocalizeOptions()
        )
        for has_depths in (False, True)
    }
    alone = answers[False]
    if isinstance(alone.outcome, Localization):
        assert isinstance(alone.support, PosedSupport)
        assert alone.support.two_view is not None
    outcome, support = answers[True].outcome, answers[True].support
    assert isinstance(outcome, Localization)
    assert isinstance(support, PosedSupport)
    assert support.two_view is None
    assert np.linalg.norm(outcome.world_from_camera.translation - SCENE.world_from_query.translation) < 0.02


def test_rough_depths_of_several_references_serve_together() -> None:
    """References that share no point, 3 m away with depths wrong by a fifth: the rung from depths is nearer."""
    options = SceneOptions(150, reference_count=3, distance_m=3.0, query_offset_m=(1.5, -0.15, 0.3))
    errors = []
    for seed in range(3):
        scene = make_scene(random_for("rung", seed), options)
        given = list[PosedView]()
        for i, (reference, seen) in enumerate(zip(scene.references, scene.reference_points, strict=True)):
            kept = np.flatnonzero((seen % 3 == i) & (seen >= 0))
            depth = reference.world_from_camera.inverse().apply(scene.x_in_world[seen[kept]])[:, 2]
            depth *= np.exp(np.random.default_rng(seed).normal(0, 0.2, len(depth)))
            features = reference.view.features
            arrays = features.keypoints[kept], features.descriptors[kept], features.sizes_px[kept]
            depths = replace(keypoint_depths(depth, 0.2), common_sigma=0.02, source=DepthSource.MEASURED)
            given.append(replace(reference, view=replace(reference.view, features=Features(*arrays)), depths=depths))
        prepared = prepare(scene.query, given, Pipeline(), LocalizeOptions(), StageContext())
        assert isinstance(prepared, Prepared)
        (coarse,) = reconstruct([prepared])
        assert isinstance(coarse, Coarse)
        found = {it.attempt.solver: it for it, _ in attempts(coarse, DoubtOptions(radius_m=0.01))}
        outcomes = [found[solver].answer.outcome for solver in (Solver.POINTS, Solver.DEPTHS)]
        centres = [it.world_from_camera.translation for it in outcomes if isinstance(it, Localization)]
        errors.append(np.linalg.norm(np.array(centres) - scene.world_from_query.translation, axis=1))
    points, depths_alone = np.array(errors).T
    assert (depths_alone < 0.05).all()
    assert np.median(depths_alone) < np.median(points)


@pytest.mark.parametrize("variant", [Variant.COARSE, Variant.NO_STRUCTURE, Variant.FULL])
def test_the_papers_variants_use_no_depths_in_their_points(variant: Variant) -> None:
    references = tuple(with_depths(i) for i in range(3))
    answer = localize(SCENE.query, references, Pipeline(), LocalizeOptions(variant=variant))
    assert answer.support is None or answer.support.structure.planes is None


def test_depths_are_read_at_the_keypoints_nearest_pixel() -> None:
    camera = SCENE.query.camera
    depth = np.full((camera.height_px // 2, camera.width_px // 2), np.nan, np.float32)
    column, row = np.rint((SCENE.query.features.keypoints[0] - 0.5) / 2).astype(int)
    depth[row, column] = 3.0
    kept = KeptDepth(camera.resized(camera.width_px // 2, camera.height_px // 2), depth, 0.02)
    found = kept.at_keypoints(SCENE.query)
    assert found.depth[0] == 3.0
    assert np.isnan(found.depth).sum() >= len(found.depth) - 5


def test_a_map_of_another_size_than_its_camera_is_an_error() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        KeptDepth(SCENE.query.camera, np.ones((2, 2), np.float32), 0.02)
    with pytest.raises(ValueError, match="relative_sigma"):
        KeptDepth(SCENE.query.camera.resized(2, 2), np.ones((2, 2), np.float32), 0.0)


@pytest.mark.parametrize("source", list(DepthSource))
def test_one_reference_with_depths_is_enough(source: DepthSource) -> None:
    reference = with_depths(0, noise=0.01)
    assert reference.depths is not None
    depths = replace(reference.depths, common_sigma=0.02, source=source)
    answer = localize(SCENE.query, [replace(reference, depths=depths)], Pipeline(), LocalizeOptions())
    outcome = answer.outcome
    assert isinstance(outcome, Localization)
    step = SCENE.world_from_query.translation - reference.world_from_camera.translation
    assert np.linalg.norm(outcome.world_from_camera.translation - SCENE.world_from_query.translation) < 0.02
    assert outcome.scale_source is {DepthSource.NETWORK: ScaleSource.NETWORK}.get(source, ScaleSource.DEPTH)
    assert outcome.covariance is not None
    along = step / np.linalg.norm(step)
    assert along @ outcome.covariance[:3, :3] @ along > (0.02 * np.linalg.norm(step)) ** 2
    without = localize(SCENE.query, [replace(reference, depths=None)], Pipeline(), LocalizeOptions()).outcome
    assert not isinstance(without, Localization)


def test_depths_that_share_no_factor_stay_as_they_are() -> None:
    """A sigma of 0: the factor is known to be 1, whatever triangulated points say."""
    reference = with_depths(0, noise=0.005, factor=1.05)
    assert reference.depths is not None
    references = (replace(reference, depths=replace(reference.depths, common_sigma=0.0)), *SCENE.references[1:])
    structure, correspondences = matched(references)
    kept = structure.tracks.select(np.arange(len(structure.x_in_world)) % 2 == 0)
    half = replace(structure, x_in_world=structure.x_in_world[::2], tracks=kept)
    found = with_kept_depths(half, references, correspondences, ALWAYS)
    single = found.tracks.select(~found.triangulated)
    of_first = single.view == 0
    points = found.x_in_world[len(half.x_in_world) :][of_first]
    seen = reference.world_from_camera.inverse().apply(points)[:, 2]
    assert of_first.sum() > 50
    np.testing.assert_allclose(seen, reference.depths.depth[single.keypoint[of_first]], rtol=1e-6)
    assert found.planes is not None
    assert not found.planes.common[~found.triangulated][of_first].any()
