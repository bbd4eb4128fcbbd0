"""Series of metrics, limited in number."""

from collections.abc import Iterable
from typing import Generic, TypeVar

from prometheus_client.metrics import MetricWrapperBase

OTHER = "other"
MAX_CHILDREN = 64
"""Far above the number of stages and operations. There may be more buckets, of which there is one for every number of
references and size of image: further ones are counted together, as "other"."""

M = TypeVar("M", bound=MetricWrapperBase)


class Children(Generic[M]):
    """The children of a metric by label values, limited in number; a dict, because every call looks up some."""

    def __init__(self, metric: M, known: Iterable[tuple[str, ...]] = (), unknown: int = MAX_CHILDREN) -> None:
        """Makes the known children at once, and at most so many more."""
        self._metric = metric
        self._children = {values: metric.labels(*values) for values in known}
        self._limit = len(self._children) + unknown

    def __call__(self, *values: str) -> M:
        """The child of these values; that of "other" if there are too many."""
        child = self._children.get(values)
        if child is None:
            if len(self._children) >= self._limit:
                values = (OTHER,) * len(values)
            child = self._children[values] = self._metric.labels(*values)
        return child
