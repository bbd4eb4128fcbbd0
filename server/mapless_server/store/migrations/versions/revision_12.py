"""Revision 12: the depth that was measured with references."""

import sqlalchemy as sa
from alembic import op

revision = "12"
down_revision = "11"


def upgrade() -> None:
    """Adds a table, whose rows are deleted with the references, and a column; servers of revision 11 ignore them.

    They answer references with depth as those without.
    """
    op.create_table(
        "depth",
        sa.Column("reference_key", sa.String(32), sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
    )
    op.add_column("reference", sa.Column("depth_sha256", sa.String(64)))
