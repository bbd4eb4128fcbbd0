"""Revision 6 (expand): self-calibrations of scenes."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "6"
down_revision = "5"

_SCENE_KEY = sa.String(257).with_variant(sa.String(257, collation="C"), "postgresql")


def upgrade() -> None:
    """Adds a table that servers of revision 5 ignore; its rows are deleted with the scenes."""
    op.create_table(
        "scene_calibration",
        sa.Column("scene_id", _SCENE_KEY, sa.ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
        sa.Column("kind", sa.String(255), primary_key=True),
        sa.Column("generation", sa.BigInteger(), nullable=True),
        sa.Column("due_time_us", sa.BigInteger(), nullable=False),
        sa.Column("failure_count", sa.Integer(), nullable=False, server_default=sa.text("0")),
        sa.Column("data", sa.LargeBinary(), nullable=True),
        sa.Column("sha256", sa.String(64), nullable=True),
    )
    write_version(op.get_bind(), 6)
