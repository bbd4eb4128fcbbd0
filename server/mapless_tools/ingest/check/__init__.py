"""Checks whether photographs fit their poses: matched points of neighbours must satisfy the epipolar constraint.

It is made before anything is uploaded. Wrong poses may not show which photographs are near each other, so if they do
not fit, photographs that are near in the folder's order are compared as well.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features import FeatureExtractor, SiftExtractor
from mapless_server.method.readings import MatchedPair, Pair, Verdict, consistent_matches, judge
from mapless_server.method.views import PosedView
from mapless_server.settings import available_cores
from mapless_tools.dataset import Frame
from mapless_tools.progress import Progress

from .pairs import more_pairs, pairs_by_order, pairs_by_pose

__all__ = ["check_frames"]


MAX_SUSPECTED = 12
"""Photographs of bad pairs that are compared with more neighbours, to find out which of the two it is."""
MORE_PAIRS = 3

LIMITS = ImageLimits(max_bytes=2**28, max_pixels=200_000_000)
"""Of photographs that are compared here; the server has limits of its own."""


def check_frames(frames: Sequence[Frame], progress: Progress, extractor: FeatureExtractor | None = None) -> Verdict:
    """Judges frames, by their indices, by SIFT or other features; those that cannot be read are left out."""
    poses = [frame.world_from_camera for frame in frames]
    if len(frames) < 2:
        return judge({}, [])
    work = _Comparison(frames, extractor or SiftExtractor(), progress)
    work.compare(pairs_by_pose(poses))
    verdict = work.verdict()
    if verdict.is_wrong or len(verdict.pairs) <= verdict.unmatched_count:
        work.compare(pairs_by_order(len(frames)))
        return work.verdict()
    suspected = list(dict.fromkeys(i for error in verdict.pairs if error.is_bad for i in error.pair))[:MAX_SUSPECTED]
    for reference in suspected:
        work.compare(more_pairs(poses, reference, work.pairs, MORE_PAIRS))
    return work.verdict() if suspected else verdict


@dataclass
class _Comparison:
    """Pairs compared so far, and their views."""

    frames: Sequence[Frame]
    extractor: FeatureExtractor
    progress: Progress
    views: dict[int, PosedView | None] = field(default_factory=dict)
    matched: list[MatchedPair] = field(default_factory=list)
    pairs: list[Pair] = field(default_factory=list)

    def compare(self, pairs: Sequence[Pair]) -> None:
        """Describes and matches pairs that were not compared before."""
        new = [pair for pair in pairs if pair not in self.pairs]
        missing = sorted({i for pair in new for i in pair} - self.views.keys())
        with ThreadPoolExecutor(available_cores()) as threads:
            for done, (i, view) in enumerate(zip(missing, threads.map(self._view, missing), strict=True), 1):
                self.views[i] = view
                self.progress("checking poses", done, len(missing))
            found = list(threads.map(self._match, new))
        self.pairs += new
        self.matched += [item for item in found if item is not None and len(item.matches)]

    def verdict(self) -> Verdict:
        views = {i: view for i, view in self.views.items() if view is not None}
        readable = sum(views.keys() >= set(pair) for pair in self.pairs)
        return judge(views, self.matched, readable - len(self.matched))

    def _view(self, index: int) -> PosedView | None:
        frame = self.frames[index]
        try:
            image = decode_image(frame.image_path.read_bytes(), LIMITS)
        except (OSError, InvalidArgument):
            return None
        if image.shape[:2] != (frame.camera.height_px, frame.camera.width_px):
            return None
        view = self.extractor.extract(image, frame.camera)
        return PosedView(str(index), frame.name, view, frame.world_from_camera)

    def _match(self, pair: Pair) -> MatchedPair | None:
        first, second = (self.views[i] for i in pair)
        if first is None or second is None:
            return None
        return MatchedPair(pair, consistent_matches(first.view, second.view))
