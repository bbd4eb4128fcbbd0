"""The pairs of photographs that are compared in a large scene."""

from collections.abc import Mapping, Sequence

from mapless_server.scenes.retrieval.vlad import VladDescriptor
from mapless_tools.progress import Progress
from mapless_tools.reconstruct.features import FeatureFolder
from mapless_tools.reconstruct.matching import PairOptions, pairs_of


def pairs_with_references(
    names: Sequence[str],
    features: FeatureFolder,
    descriptor: VladDescriptor,
    options: PairOptions,
    progress: Progress,
    *,
    count: int,
    alike: Mapping[str, frozenset[str]],
) -> list[tuple[str, str]]:
    """Pairs of the first `count` photographs, the references, of the others, and of each other with those like it."""
    references, new = names[:count], names[count:]
    among = [pairs_of(its, features, descriptor, options, progress) for its in (references, new)]
    return [*among[0], *among[1], *((it, other) for it in references for other in new if it in alike[other])]
