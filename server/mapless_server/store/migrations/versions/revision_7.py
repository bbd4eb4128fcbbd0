"""Revision 7 (expand): depths that are stored with references."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "7"
down_revision = "6"


def upgrade() -> None:
    """Adds a table that servers of revision 6 ignore; its rows are deleted with the references."""
    op.create_table(
        "reference_depth",
        sa.Column("reference_key", sa.String(32), sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("kind", sa.String(255), primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
    )
    write_version(op.get_bind(), 7)
