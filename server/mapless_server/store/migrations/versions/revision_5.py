"""Revision 5 (expand): when each matching was last used."""

import time

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "5"
down_revision = "4"

_MATCHING = sa.String(255)


def upgrade() -> None:
    """Adds a table that servers of revision 4 ignore; existing matchings count as used now."""
    use = op.create_table(
        "matching_use",
        sa.Column("matching", _MATCHING, primary_key=True),
        sa.Column("used_time_us", sa.BigInteger(), nullable=False),
    )
    now_us = sa.literal(round(time.time() * 1_000_000), sa.BigInteger())
    known = sa.select(sa.table("reference_matching", sa.column("matching", _MATCHING)).c.matching, now_us).distinct()
    op.get_bind().execute(sa.insert(use).from_select(["matching", "used_time_us"], known))
    write_version(op.get_bind(), 5)
