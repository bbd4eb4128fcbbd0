"""Revision 13: the labels of scenes."""

import sqlalchemy as sa
from alembic import op

revision = "13"
down_revision = "12"


def upgrade() -> None:
    """Adds a table, whose rows are deleted with the scenes; servers of revision 12 ignore it."""
    op.create_table(
        "scene_label",
        sa.Column(
            "scene_id",
            sa.String(257).with_variant(sa.String(257, collation="C"), "postgresql"),
            sa.ForeignKey("scene.scene_id", ondelete="CASCADE"),
            primary_key=True,
        ),
        sa.Column("name", sa.String(64), primary_key=True),
        sa.Column("value", sa.String(128), nullable=False),
    )
    op.create_index("scene_label_by_value", "scene_label", ["name", "value"])
