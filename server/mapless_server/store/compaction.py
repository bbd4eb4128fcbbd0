"""Rewrites stored features that 0.2.0 wrote as float32 in 8 bits, a quarter of the bytes, while the server runs."""

import logging
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, delete, select, tuple_

from mapless_server.errors import NotFound
from mapless_server.method.features.views import Features, rounded_descriptors

from . import codec, queries, rows
from .database import Database, unless_damaged
from .tables import features

log = logging.getLogger(__name__)

_AT_ONCE = 64


def compact_features(database: Database, pause: Callable[[], None]) -> list[tuple[str, str]]:
    """Rewrites all features that are stored as float32; returns the references' keys and extractors.

    Damaged ones are not changed. Several servers may do this at once. Calls `pause`, which may wait or raise, before
    each one; what was rewritten until then is stored.
    """
    rewritten: list[tuple[str, str]] = []
    after = ("", "")
    column = features.c
    while True:
        waiting: Select[Any] = (
            select(column.reference_key, column.extractor)
            .where(tuple_(column.reference_key, column.extractor) > after)
            .where(~column.extractor.endswith(rows.SMALL_FEATURES))
            .order_by(column.reference_key, column.extractor)
        )
        with database.read() as connection:
            found = connection.execute(waiting.limit(_AT_ONCE)).all()
        if not found:
            if rewritten:
                log.info("%d features are stored in 8 bits now", len(rewritten))
            return rewritten
        for key, extractor in found:
            pause()
            if _rewrite(database, key, extractor):
                rewritten.append((key, extractor))
        after = tuple(found[-1])


def _rewrite(database: Database, key: str, extractor: str) -> bool:
    column = features.c
    is_it = (column.reference_key == key) & (column.extractor == extractor)
    with database.read() as connection:
        statement: Select[Any] = select(column.data, column.sha256).where(is_it)
        row = unless_damaged(connection, lambda: connection.execute(statement).one_or_none(), lambda: None)
    if row is None:
        return False
    try:
        view = codec.decode_view(rows.features_owner(key, extractor), row.data, row.sha256)
        small = rows.features_row(key, extractor, replace(view, features=in_8_bits(view.features)))
    except (codec.Damaged, ValueError):
        return False
    with database.write() as connection:
        try:
            queries.lock_reference(connection, key)
        except NotFound:
            return False
        queries.insert_new(connection, features, small)
        connection.execute(delete(features).where(is_it))
    return True


def in_8_bits(given: Features) -> Features:
    """Converts descriptors to 8 bits: to the histograms that they were made of, or rounded."""
    histograms = _histograms(given.descriptors) if given.descriptors.dtype == np.float32 else given.descriptors
    small = rounded_descriptors(given.unit_descriptors()) if histograms is None else histograms
    return replace(given, descriptors=small)


def _histograms(descriptors: NDArray[Any]) -> NDArray[np.uint8] | None:
    """Whole numbers (N, D) whose shares have these square roots, to the last bit; None if there are none.

    The smallest share is that of a small whole number, mostly 1, which determines the sum.
    """
    if not (descriptors >= 0).all():
        return None
    shares = descriptors.astype(np.float64) ** 2
    found = np.zeros(shares.shape, np.uint8)
    unknown = np.arange(len(shares))
    smallest = np.where(shares > 0, shares, np.inf).min(axis=1, initial=np.inf)
    for number in range(1, 17):
        rounded = np.rint(shares[unknown] * np.rint(number / smallest[unknown])[:, None])
        found[unknown] = np.minimum(rounded, 255)
        candidate = Features(
            np.zeros((len(unknown), 2), np.float32), found[unknown], np.zeros(len(unknown), np.float32)
        )
        unknown = unknown[(candidate.unit_descriptors() != descriptors[unknown]).any(axis=1)]
    return None if len(unknown) else found
