"""Options of matching by LightGlue, without torch, which computes it."""

from dataclasses import dataclass

from mapless_server.bounds import check_bounds

from .limits import MAX_KEYPOINTS


@dataclass(frozen=True)
class LightGlueOptions:
    """Options of matching by LightGlue.

    Attributes:
        min_score: least probability of a match; the authors' value.
        max_keypoints: largest number of keypoints of a photograph that are matched, the strongest ones (extractors
            return these first). The time is quadratic in it.
        pairs_at_once: batch size; all pairs of a query on a GPU. A CPU does not gain from batches.
        half: compute in float16, as the authors do on a GPU.
    """

    min_score: float = 0.1
    max_keypoints: int = MAX_KEYPOINTS
    pairs_at_once: int = 32
    half: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, "min_score", at_least=0, below=1)
        check_bounds(self, "max_keypoints pairs_at_once", at_least=1)

    def label(self, weights_sha256: str) -> str:
        """Names all that determines the matches, except for the photographs."""
        return "-".join(
            ["lightglue", weights_sha256[:8], *map(str, (self.min_score, self.max_keypoints, *CONFIDENCES))]
        )


CONFIDENCES = 0.95, 0.99
"""The authors' depth and width confidence, see `LightGlue.match_one`, with which it takes half the time."""

CPU_OPTIONS = LightGlueOptions(max_keypoints=MAX_KEYPOINTS // 2, pairs_at_once=1)
"""On a CPU, where time is quadratic in the keypoints; pairs together take no less than one after the other."""

CUDA_OPTIONS = LightGlueOptions(half=True)
