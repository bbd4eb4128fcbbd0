"""Depths that are stored with references, of one or more kinds.

A *kind* names everything that determines a depth besides the photographs: the version of making and checking it, the
network and its weights. Depths of another version are never read. Finished references are recorded as for pairs
(see `pairs`), under the kind's name; if a finished one has no depth, this was found wrong, or could not be checked.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, delete, select, update

from mapless_server.method.features.views import KeptDepth

from . import codec, queries, rows
from .database import Database
from .tables import reference, reference_depth, reference_matching

DEPTH_VERSION = 1
"""Version of the way depths are made, checked and encoded; to be raised by every change that makes those that are kept
wrong."""

_OF_VERSION = f"depth-{DEPTH_VERSION}/"


def depth_kind(network: str, weights_sha256: str) -> str:
    """The kind of depth that a network predicts."""
    return f"{_OF_VERSION}{network}/{weights_sha256}"


@dataclass(frozen=True)
class FoundDepths:
    """The depths stored with some references, by the reference's key.

    Damaged are kinds and keys of damaged depths; others of the same reference are used.
    """

    depths: dict[str, KeptDepth]
    damaged: frozenset[tuple[str, str]]


def load_depths(database: Database, keys: Collection[str], kind: str | None = None) -> FoundDepths:
    """Loads the depths stored with references, of one kind, or of the first existing kind of the present version."""
    column = reference_depth.c
    of_kind = column.kind.startswith(_OF_VERSION, autoescape=True) if kind is None else column.kind == kind
    stored: Select[Any] = select(column.reference_key, column.kind, column.data, column.sha256)
    with database.read() as connection:
        found = connection.execute(stored.where(column.reference_key.in_(keys), of_kind).order_by(column.kind)).all()
    depths: dict[str, KeptDepth] = {}
    damaged = set()
    for row in found:
        if row.reference_key in depths:
            continue
        try:
            depths[row.reference_key] = codec.decode_depth(_owner(row.reference_key, row.kind), row.data, row.sha256)
        except codec.Damaged:
            damaged.add((row.kind, row.reference_key))
    return FoundDepths(depths, frozenset(damaged))


def list_without(database: Database, kind: str, keys: Collection[str]) -> list[str]:
    """Those of these references, in order, without a stored depth of a kind."""
    column = reference_depth.c
    with database.read() as connection:
        kept = set(
            connection.scalars(select(column.reference_key).where(column.kind == kind, column.reference_key.in_(keys)))
        )
    return [key for key in keys if key not in kept]


def keep_depths(database: Database, kind: str, depths: Mapping[str, KeptDepth]) -> None:
    """Stores depths of the references that still exist, unless they have some already."""
    encoded = {key: codec.encode_depth(it) for key, it in sorted(depths.items())}
    with database.write() as connection:
        existing = select(reference.c.key).where(reference.c.key.in_(encoded)).order_by(reference.c.key)
        for key in connection.scalars(existing.with_for_update(read=True, key_share=True)).all():
            row = {"reference_key": key, "kind": kind, "data": encoded[key]}
            row["sha256"] = codec.sha256_for(_owner(key, kind), encoded[key])
            queries.insert_new(connection, reference_depth, row)


def discard_depths(database: Database, damaged: Collection[tuple[str, str]]) -> None:
    """Deletes damaged depths, by kind and key; their references are claimed again."""
    column, progress = reference_depth.c, reference_matching.c
    with database.write() as connection:
        for kind, key in sorted(damaged):
            connection.execute(delete(reference_depth).where(column.reference_key == key, column.kind == kind))
            of_it = (progress.reference_key == key) & (progress.matching == kind) & progress.due_time_us.is_(None)
            connection.execute(update(reference_matching).where(of_it).values(due_time_us=rows.now_us()))


def list_kinds(database: Database) -> list[str]:
    """The kinds of the present version that are stored with any reference."""
    column = reference_depth.c
    with database.read() as connection:
        kinds = select(column.kind).where(column.kind.startswith(_OF_VERSION, autoescape=True)).distinct()
        return sorted(connection.scalars(kinds))


def _owner(key: str, kind: str) -> str:
    """Owner of a depth, for `codec.sha256_for`."""
    return f"{key} {kind}"
