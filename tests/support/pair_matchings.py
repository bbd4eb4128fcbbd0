"""A pair matching that takes no network."""

from collections.abc import Callable

from mapless_server.method.nearest import mutual_matches
from mapless_server.method.views import Matches, View


class AnyRatio:
    """Nearest neighbours without a ratio; which pairs were seen."""

    name = "any-ratio"

    def __init__(self) -> None:
        self.seen: list[tuple[View, View]] = []

    def match_one(self, first: View, second: View, pause: Callable[[], None] = lambda: None) -> Matches:
        pause()
        self.seen.append((first, second))
        return mutual_matches(first.features, second.features, 1.0)
