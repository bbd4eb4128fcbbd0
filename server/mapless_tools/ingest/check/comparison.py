"""Pairs of photographs that are described and matched, each once, without what is fixed to their cameras."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, image_size
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import Matches, PosedView
from mapless_server.method.pairs.readings.errors import MatchedPair, Pair, consistent, distinct_matches
from mapless_server.method.pairs.readings.verdict import Verdict, judge
from mapless_server.method.pairs.stationary import fixed_in, without_ignored
from mapless_server.settings import available_cores
from mapless_tools.dataset import Frame
from mapless_tools.progress import Progress

LIMITS = ImageLimits(max_bytes=2**28, max_pixels=200_000_000)
"""Limits of photographs that are compared here; the server has its own."""


@dataclass
class Comparison:
    """Pairs compared so far, and their views."""

    frames: Sequence[Frame]
    extractor: FeatureExtractor
    progress: Progress
    views: dict[int, PosedView | None] = field(default_factory=dict)
    distinct: dict[Pair, Matches] = field(default_factory=dict)
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
            usable = [pair for pair in new if self.readable().keys() >= set(pair)]
            self.distinct |= dict(zip(usable, threads.map(self._match, usable), strict=True))
            self.pairs += new
            found = threads.map(self._consistent, *self._without_fixed())
            self.matched = [item for item in found if len(item.matches)]

    def verdict(self) -> Verdict:
        """The verdict on all pairs so far."""
        views = self.readable()
        matched = {item.pair for item in self.matched}
        unmatched = [pair for pair in self.pairs if views.keys() >= set(pair) and pair not in matched]
        return judge(views, self.matched, len(unmatched), unmatched)

    def readable(self) -> dict[int, PosedView]:
        """The views of the photographs that could be read."""
        return {i: view for i, view in self.views.items() if view is not None}

    def _view(self, index: int) -> PosedView | None:
        frame = self.frames[index]
        try:
            if image_size(frame.image_path.read_bytes(), LIMITS) != (frame.camera.width_px, frame.camera.height_px):
                return None
            view = frame.described(self.extractor, LIMITS)
        except (OSError, InvalidArgument):
            return None
        return PosedView(str(index), frame.name, view, frame.world_from_camera)

    def _posed(self, index: int) -> PosedView:
        view = self.views[index]
        assert view is not None
        return view

    def _match(self, pair: Pair) -> Matches:
        return distinct_matches(*(self._posed(i).view for i in pair))

    def _without_fixed(self) -> tuple[Sequence[Pair], Sequence[Matches]]:
        """The pairs and their matches, without those of what is fixed to a camera, such as a badge or a bonnet."""
        compared = sorted({i for pair in self.distinct for i in pair})
        index, views = {i: k for k, i in enumerate(compared)}, [self._posed(i) for i in compared]
        fixed = fixed_in(views, {(index[a], index[b]): it for (a, b), it in self.distinct.items()})
        ignored = {i: fixed.of(self._posed(i).view) for i in compared}
        kept = [without_ignored(it, ignored[a], ignored[b]) for (a, b), it in self.distinct.items()]
        return list(self.distinct), kept

    def _consistent(self, pair: Pair, matches: Matches) -> MatchedPair:
        first, second = (self._posed(i).view for i in pair)
        return MatchedPair(pair, consistent(first, second, matches))
