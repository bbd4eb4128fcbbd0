"""References that have one of many values in a column, a few of each, in few statements.

Up to a hundred references are added together; a server far from its database should not ask two hundred times for them.
"""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

from sqlalchemy import Connection, Executable, Row, bindparam, select, union_all

from mapless_server.security import SceneKey

from .tables import reference

_TOGETHER = (1, 8, 64)
"""Numbers of values that a statement has: few, since each is compiled once. If fewer are left, the last is repeated."""


def find_alike(
    connection: Connection, scene_key: SceneKey, column: str, values: Sequence[Any], most: int
) -> Iterator[Row[Any]]:
    """References of a scene with one of these values, any `most` of each; some may come twice."""
    for begin in range(0, len(values), _TOGETHER[-1]):
        together = values[begin : begin + _TOGETHER[-1]]
        count = next(it for it in _TOGETHER if it >= len(together))
        padded = [*together, *[together[-1]] * (count - len(together))]
        named = {f"value_{i}": value for i, value in enumerate(padded)}
        yield from connection.execute(_statement(column, count), {"scene_key": scene_key, "most": most} | named)


@cache
def _statement(column: str, count: int) -> Executable:
    """A union, since a limit holds for each value: else a scene whose photographs all have one pose would be read."""
    in_scene = select(reference).where(reference.c.scene_id == bindparam("scene_key")).limit(bindparam("most"))
    each = (in_scene.where(reference.c[column] == bindparam(f"value_{i}")).subquery() for i in range(count))
    return union_all(*map(select, each))
