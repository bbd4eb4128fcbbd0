"""Checks whether photographs fit their poses: matched points of neighbours must satisfy the epipolar constraint.

It is made before anything is uploaded. Wrong poses may not show which photographs are near each other, so if they do
not fit, photographs that are near in the folder's order are compared as well.
"""

from collections.abc import Sequence

from mapless_server.method.features.extractors import FeatureExtractor, SiftExtractor
from mapless_server.method.pairs.readings.verdict import Verdict, judge
from mapless_tools.dataset import Frame
from mapless_tools.progress import Progress

from .comparison import Comparison
from .pairs import more_pairs, pairs_by_order, pairs_by_pose, pairs_of_same_pose
from .scene import SceneVerdict, check_with_scene

__all__ = ["SceneVerdict", "check_frames", "check_with_scene"]


MAX_SUSPECTED = 12
"""Photographs of bad pairs that are compared with more neighbours, to find out which of the two it is."""
MORE_PAIRS = 3


def check_frames(frames: Sequence[Frame], progress: Progress, extractor: FeatureExtractor | None = None) -> Verdict:
    """Judges frames, by their indices, by SIFT or other features; those that cannot be read are left out."""
    poses = [frame.world_from_camera for frame in frames]
    if len(frames) < 2:
        return judge({}, [])
    work = Comparison(frames, extractor or SiftExtractor(), progress)
    work.compare([*pairs_by_pose(poses), *pairs_of_same_pose(poses)])
    verdict = work.verdict()
    if verdict.is_wrong or len(verdict.pairs) <= verdict.unmatched_count:
        work.compare(pairs_by_order(len(frames)))
        return work.verdict()
    suspected = list(dict.fromkeys(i for error in verdict.pairs if error.is_bad for i in error.pair))[:MAX_SUSPECTED]
    for reference in suspected:
        work.compare(more_pairs(poses, reference, work.pairs, MORE_PAIRS))
    return work.verdict() if suspected else verdict
