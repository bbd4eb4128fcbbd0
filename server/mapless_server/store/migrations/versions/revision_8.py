"""Revision 8 (expand): masks of references."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "8"
down_revision = "7"


def upgrade() -> None:
    """Adds a table, whose rows are deleted with the references, and a column; servers of revision 7 ignore both.

    Features that such a server computes of a reference with a mask are of its whole image.
    """
    op.create_table(
        "mask",
        sa.Column("reference_key", sa.String(32), sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
    )
    op.add_column("reference", sa.Column("mask_sha256", sa.String(64)))
    write_version(op.get_bind(), 8)
