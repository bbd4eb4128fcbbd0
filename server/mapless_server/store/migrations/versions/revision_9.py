"""Revision 9 (expand): how far pairs of references are from agreeing with their poses."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "9"
down_revision = "8"


def upgrade() -> None:
    """Adds a column that servers of revision 8 ignore; pairs that they or earlier ones have made have no error."""
    op.add_column("reference_pair", sa.Column("error_px", sa.Double(), nullable=True))
    write_version(op.get_bind(), 9)
