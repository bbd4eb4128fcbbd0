"""Views of a planted box of points with known poses, and the matches of their pairs."""

from functools import cache
from itertools import combinations

import numpy as np

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.method.features.views import PosedView
from mapless_server.method.pairs.readings.errors import MatchedPair, consistent, distinct_matches

from .scenes import SceneOptions, look_at, observe, random_for, unit_rows


@cache
def planted(count: int = 8) -> list[PosedView]:
    """Views of a box of points, lifted and rolled so that no mistake is a symmetry; some matches are wrong."""
    random = random_for("epipolar")
    options = SceneOptions(point_count=250, outlier_share=0.05, distractor_count=50)
    x_in_world = (random.random((options.point_count, 3)) - 0.5) * options.box_m
    descriptors = unit_rows(random.standard_normal((options.point_count, options.descriptor_size)))
    world_from_scene = RigidTransform(rotation_from_vector([0.9, -0.4, 1.3]), np.array([3.0, -5.0, 2.0]))
    views = []
    for i, across in enumerate(np.linspace(-2, 2, count)):
        upright = look_at(np.array([across, random.uniform(-1, 1), -4.0]), random.uniform(-0.4, 0.4, 3))
        roll = rotation_from_vector([0.0, 0.0, random.uniform(-0.5, 0.5)])
        pose = RigidTransform(upright.rotation @ roll, upright.translation)
        view, _ = observe(random, options, x_in_world, descriptors, pose)
        views.append(PosedView(f"key-{i}", f"r{i}", view, world_from_scene.compose(pose)))
    return views


@cache
def matched(count: int = 8) -> list[MatchedPair]:
    """Matches of the planted views, which do not depend on poses."""
    views, found = planted(count), []
    for i, j in combinations(range(len(views)), 2):
        first, second = views[i].view, views[j].view
        matches = consistent(first, second, distinct_matches(first, second))
        if j - i <= 3 and len(matches):
            found.append(MatchedPair((i, j), matches))
    return found
