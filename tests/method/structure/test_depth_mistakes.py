"""Wrong depths by planted rectangles before a wall: each mistake is named, and nothing where there is none."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import random_for
from support.walls import CAMERA, Walls, two_views

from mapless import DepthNoise, DepthSensor
from mapless.depth import NOISE
from mapless_server.method.structure.depth_mistakes import DepthVerdict, judge_depth
from mapless_server.method.structure.measured_depth import MeasuredDepth
from mapless_server.method.structure.seen_depths import SeenDepths, depths_of_neighbour, triangulated_depths

Depths = NDArray[np.float32]
WALLS = Walls.planted()
FIRST, SECOND, MATCHES = two_views(WALLS)
UNKNOWN = NOISE[DepthSensor.UNKNOWN]


def measured(
    view: int, change: Callable[[Depths], Depths] = lambda it: it, noise: DepthNoise = UNKNOWN
) -> MeasuredDepth:
    exact = WALLS.depth(CAMERA, (FIRST, SECOND)[view].world_from_camera)
    sigma = noise.sigma_m(exact.astype(np.float64)) / 3
    noisy = (exact + random_for("noise", view).normal(0, sigma)).astype(np.float32)
    return MeasuredDepth(CAMERA, change(noisy), noise)


def judged(
    own: MeasuredDepth, other: MeasuredDepth | None = None, has_matches: bool = True, view: int = 0
) -> DepthVerdict:
    subject, neighbour = (FIRST, SECOND) if view == 0 else (SECOND, FIRST)
    parts = [triangulated_depths(subject, neighbour, MATCHES)] if has_matches else []
    if other is not None:
        parts.append(depths_of_neighbour(subject, neighbour, other, 10_000))
    return judge_depth(subject, own, SeenDepths.of(parts))


def longer(factor: float) -> Callable[[Depths], Depths]:
    return lambda it: it * np.float32(factor)


def shifted(values: Depths) -> Depths:
    return np.pad(values, ((0, 0), (10, 0)), constant_values=np.nan)[:, :-10].astype(np.float32)


def enlarged(values: Depths) -> Depths:
    rows, columns = (
        np.clip(np.rint((np.arange(n) - (n - 1) / 2) / 1.115 + (n - 1) / 2), 0, n - 1) for n in values.shape
    )
    return values[np.ix_(rows.astype(int), columns.astype(int))]


def foreign(values: Depths) -> Depths:
    return np.roll(values[::-1], (37, 111), (0, 1))


MISTAKES: list[tuple[Callable[[Depths], Depths], str]] = [
    (lambda it: it * np.float32(1000), "100. times as long as .* millimetres"),
    (lambda it: it * np.float32(0.001), "0.00100. times as long as .* metres"),
    (lambda it: it * np.float32(1.15), "1.1[45].* times as long"),
    (lambda it: it * np.float32(0.85), "0.85.* times as long"),
    (lambda it: it[:, ::-1], "mirrored, left for right"),
    (lambda it: it[::-1], "mirrored, top for bottom"),
    (lambda it: it[::-1, ::-1], "turned by 180 degrees"),
    (shifted, r"shifted by about \(8, 0\)"),
    (enlarged, "enlarged 1.1 times, as of another camera"),
    (foreign, "does not fit the photograph"),
]
IDS = ["millimetres", "metres", "long", "short", "mirrored", "upside down", "turned", "shifted", "camera", "foreign"]


@pytest.mark.parametrize("has_neighbour", [True, False])
def test_right_depths_are_not_accused(has_neighbour: bool) -> None:
    found = judged(measured(0), measured(1) if has_neighbour else None)
    assert (found.mistake, found.doubt) == ("", "")
    assert found.agreeing_share > 0.9
    assert found.factor == pytest.approx(1, abs=3 * found.factor_sigma)
    assert found.factor_sigma < 0.02


@pytest.mark.parametrize(("change", "text"), MISTAKES, ids=IDS)
def test_a_mistake_is_named_of_the_reference_that_has_it(change: Callable[[Depths], Depths], text: str) -> None:
    wrong, right = measured(0, change), measured(1)
    assert re.search(text, judged(wrong, right).mistake)
    assert judged(right, wrong, view=1).mistake == ""


def test_the_factor_of_a_kind_is_allowed_and_a_larger_one_not() -> None:
    """Three of its standard deviations, those of the estimate included."""
    noise = replace(NOISE[DepthSensor.STRUCTURED_LIGHT])
    for factor, is_wrong in ((1.03, False), (0.97, False), (1.1, True), (0.9, True)):
        found = judged(measured(0, longer(factor), noise))
        assert bool(found.mistake) is is_wrong, factor
    lax = replace(noise, common=0.1)
    assert judged(measured(0, lambda it: it * np.float32(1.1), lax)).mistake == ""


def test_a_reading_with_which_no_more_places_agree_is_not_named() -> None:
    """The noise lets a shifted image fit, too, though less well."""
    wide = measured(0, lambda it: np.pad(it, ((0, 0), (24, 0)), constant_values=np.nan)[:, :-24].astype(np.float32))
    found = judged(replace(wide, noise=DepthNoise(constant_m=0.6)))
    assert found.agreeing_share > 0.98
    assert (found.mistake, found.doubt) == ("", "")


def test_without_points_one_of_two_depths_is_in_doubt() -> None:
    wrong, right = measured(0, lambda it: it[:, ::-1]), measured(1)
    found = judged(wrong, right, has_matches=False)
    assert found.mistake == ""
    assert "mirrored" in found.doubt
    long = judged(measured(0, lambda it: it * np.float32(1.1)), right, has_matches=False)
    assert "1.1 times as long as the depth of its neighbours" in long.doubt


def test_poses_that_no_matches_confirm_shift_images_but_change_no_factor() -> None:
    seen = SeenDepths.of([depths_of_neighbour(FIRST, SECOND, measured(1), 10_000)])
    mirrored = judge_depth(FIRST, measured(0, lambda it: it[:, ::-1]), seen, are_poses_right=False)
    assert (mirrored.mistake, mirrored.doubt) == ("", "")
    long = judge_depth(FIRST, measured(0, longer(1.1)), seen, are_poses_right=False)
    assert (long.mistake, "1.1 times as long" in long.doubt) == ("", True)


def test_too_few_places_say_nothing() -> None:
    few = triangulated_depths(FIRST, SECOND, MATCHES[:10])
    found = judge_depth(FIRST, measured(0, lambda it: it[:, ::-1]), few)
    assert (found.point_count, found.mistake, found.doubt) == (len(few), "", "")


def test_the_whole_image_has_the_depths_of_its_keypoints() -> None:
    """Both leave out edges and holes; the image is computed at once, in single precision."""
    depth = measured(0, lambda it: np.where(it > 4.8, np.float32(np.nan), it))
    camera, inverse = depth.inverse_in(CAMERA)
    assert camera == CAMERA
    rows, columns = np.mgrid[3:237:2, 3:317:2].reshape(2, -1)
    pixels = np.column_stack([columns, rows]).astype(np.float64)
    slow = depth.at_pixels(CAMERA, pixels)
    fast = 1 / inverse[rows, columns].astype(np.float64)
    # Of four pixels around, the slow one needs all.
    known = np.isfinite(slow)
    assert known.mean() > 0.3
    np.testing.assert_allclose(fast[known], slow[known], rtol=1e-6)
