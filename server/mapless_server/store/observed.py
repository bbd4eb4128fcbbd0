"""Who hears how long the store's operations take, and which of them fail."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from mapless_server.errors import AlreadyExists, NotFound

P = ParamSpec("P")
T = TypeVar("T")


class StoreObserver(Protocol):
    """Called in whatever thread uses the store, so it must return at once and never raise."""

    def stored(self, operation: str, seconds: float) -> None:
        """An operation ended, however it did."""

    def store_failed(self) -> None:
        """It failed by a fault that is not the caller's: damage, a full disk, a database that others keep busy."""


class Unobserved:
    """Hears nothing."""

    def stored(self, operation: str, seconds: float) -> None:
        """Implements StoreObserver."""

    def store_failed(self) -> None:
        """Implements StoreObserver."""


class Observed(Protocol):
    """Has operations that somebody hears of."""

    observer: StoreObserver


S = TypeVar("S", bound=Observed)


def observed(operation: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
    """An operation that the observer hears of, under its name."""

    @wraps(operation)
    def told(self: S, /, *args: P.args, **kwargs: P.kwargs) -> T:
        start_s = time.monotonic()
        try:
            return operation(self, *args, **kwargs)
        except (NotFound, AlreadyExists):
            raise
        except Exception:
            self.observer.store_failed()
            raise
        finally:
            self.observer.stored(operation.__name__, time.monotonic() - start_s)

    return told
