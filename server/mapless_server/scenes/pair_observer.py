"""Events of the work in the background, ahead of queries, for metrics."""


class PairObserver:
    """Receives the events in any thread; ignores them unless a method is overridden.

    Methods must return at once and never raise.
    """

    def pairs_looked_up(self, stored: int, absent: int, damaged: int) -> None:
        """A query looked for pairs of references; it matches those itself that are absent or damaged."""

    def pair_lookup_failed(self) -> None:
        """A query could not look for pairs of references, and matches all of them itself."""

    def pairs_made(self, count: int, cpu_seconds: float) -> None:
        """Pairs of a reference were matched in the background and stored."""

    def matching_failed(self) -> None:
        """Matching a reference in the background failed; it is tried again."""

    def references_wait(self, count: int) -> None:
        """Reports how many references wait to be matched in the background."""

    def depths_looked_up(self, stored: int, absent: int, damaged: int) -> None:
        """A query looked for the depths of references; it does without those that are absent or damaged."""

    def depth_lookup_failed(self) -> None:
        """A query could not look for the depths of references, and does without them."""

    def depths_made(self, kept: int, dropped: int, seconds: float) -> None:
        """A network has predicted the depths of references; some were found wrong, or could not be checked."""

    def depth_failed(self) -> None:
        """Making the depth of a reference failed; it is tried again."""

    def depths_wait(self, count: int) -> None:
        """Reports how many references wait for a network to predict their depth."""

    def scene_calibrated(self, cpu_seconds: float) -> None:
        """References of a scene were localized against the others, and the calibration was stored."""

    def calibration_failed(self) -> None:
        """Calibrating a scene from its references failed; it is tried again."""

    def scenes_wait(self, count: int) -> None:
        """Reports how many scenes have changed since they were calibrated from their references."""
