"""Revision 4 (expand): matches of pairs of references, and which references are matched."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "4"
down_revision = "3"

_KEY = sa.String(32)
_MATCHING = sa.String(255)


def upgrade() -> None:
    """Adds tables that servers of revision 3 ignore; their rows are deleted with the references."""
    op.create_table(
        "reference_pair",
        sa.Column("first_key", _KEY, sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("second_key", _KEY, sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("matching", _MATCHING, primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
    )
    op.create_index("reference_pair_by_second", "reference_pair", ["second_key"])
    op.create_table(
        "reference_matching",
        sa.Column("reference_key", _KEY, sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("matching", _MATCHING, primary_key=True),
        sa.Column("due_time_us", sa.BigInteger(), nullable=True),
        sa.Column("failure_count", sa.Integer(), nullable=False, server_default=sa.text("0")),
    )
    op.create_index("reference_matching_by_due_time", "reference_matching", ["matching", "due_time_us"])
    write_version(op.get_bind(), 4)
