"""Pairs of photographs that are described and matched, each once."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features import FeatureExtractor
from mapless_server.method.readings import MatchedPair, Pair, Verdict, consistent_matches, judge
from mapless_server.method.views import PosedView
from mapless_server.settings import available_cores
from mapless_tools.dataset import Frame
from mapless_tools.progress import Progress

LIMITS = ImageLimits(max_bytes=2**28, max_pixels=200_000_000)
"""Of photographs that are compared here; the server has limits of its own."""


@dataclass
class Comparison:
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
