"""Revision 3 (expand): attributes of a scene."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "3"
down_revision = "2"


def upgrade() -> None:
    """Adds columns that are null without attributes; servers of revision 2 leave them so."""
    op.add_column("scene", sa.Column("attributes", sa.LargeBinary(), nullable=True))
    op.add_column("scene", sa.Column("attributes_sha256", sa.String(64), nullable=True))
    write_version(op.get_bind(), 3)
