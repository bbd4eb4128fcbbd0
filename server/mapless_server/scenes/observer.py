"""Reports of background work ahead of queries, and of look-ups of its results, for metrics."""

from mapless_server.security import SceneKey


class BackgroundObserver:
    """Receives reports in any thread, and ignores them unless a method is overridden.

    Names and results are those of `observability.metrics`. Methods must return at once and never raise.
    """

    def count(self, name: str, amount: float = 1.0, result: str = "") -> None:
        """Adds a number of things, or seconds, to a count."""

    def count_in_scene(self, scene_key: SceneKey, name: str, amount: int = 1, result: str = "") -> None:
        """Adds to a count what happened in a scene; reports of scenes have it, too."""
        self.count(name, amount, result)

    def waiting(self, name: str, count: int) -> None:
        """Sets how many things wait."""

    def looked_up(self, name: str, stored: int, absent: int, damaged: int) -> None:
        """Counts what a query has looked for; it does without what is absent or damaged, or makes it itself."""
        for result, count in (("stored", stored), ("absent", absent), ("damaged", damaged)):
            self.count(name, count, result)
