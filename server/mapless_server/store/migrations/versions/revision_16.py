"""Revision 16: who showed, and when, that places need a new survey, and whose photographs were adopted."""

import sqlalchemy as sa
from alembic import op

revision = "16"
down_revision = "15"


def upgrade() -> None:
    """Adds three columns; places that were outdated before become so again by further photographs."""
    op.add_column("reference_standing", sa.Column("surveyed_by", sa.Text, nullable=False, server_default=sa.text("''")))
    op.add_column("reference_standing", sa.Column("outdate_time_us", sa.BigInteger))
    op.add_column("adopted_reference", sa.Column("adopted_by", sa.Text, nullable=False, server_default=sa.text("''")))
