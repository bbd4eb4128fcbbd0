"""Pages of lists, and the tokens that lead from one to the next."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

from mapless import names
from mapless.wire import FieldError

DEFAULT_PAGE_SIZE = 100
MAX_PAGE_SIZE = 1000

Record = TypeVar("Record")


class PageRequest(Protocol):
    """A request for a page of a list."""

    @property
    def page_size(self) -> int:
        """How much is wanted; 0 for the default."""

    @property
    def page_token(self) -> str:
        """Of the page before; empty for the first."""


class Page:
    """One page of a list: how much to ask the store for, where to begin, where the next page begins.

    A token is the tenant, the collection and the last id of the page before: opaque to callers, and good for its own
    list only.

    Raises:
        FieldError: a negative page size, or a token that this list did not give.
    """

    def __init__(
        self,
        request: PageRequest,
        tenant: str,
        collection: str,
        default_size: int = DEFAULT_PAGE_SIZE,
        max_size: int = MAX_PAGE_SIZE,
    ) -> None:
        if request.page_size < 0:
            raise FieldError("page_size", f"must not be negative, is {request.page_size}")
        self._size = min(request.page_size or default_size, max_size)
        self._list = f"{tenant}\n{collection}"
        self.limit = self._size + 1  # one more tells whether there is a next page
        self.after = self._read_token(request.page_token) if request.page_token else ""

    def cut(self, records: Sequence[Record], id_of: Callable[[Record], str]) -> tuple[Sequence[Record], str]:
        """The records of this page, and the token of the next one."""
        if len(records) <= self._size:
            return records, ""
        token = f"{self._list}\n{id_of(records[self._size - 1])}"
        return records[: self._size], base64.urlsafe_b64encode(token.encode()).decode()

    def _read_token(self, token: str) -> str:
        try:
            its_list, _, after = base64.b64decode(token, b"-_", validate=True).decode().rpartition("\n")
            if its_list == self._list:
                return names.check_id(after)
        except (binascii.Error, ValueError):
            pass
        raise FieldError("page_token", "is not one that this list gave")
