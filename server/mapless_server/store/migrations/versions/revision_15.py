"""Revision 15: counts of answered photographs."""

import sqlalchemy as sa
from alembic import op

revision = "15"
down_revision = "14"


def upgrade() -> None:
    """Adds a table, whose rows are deleted with the scenes; servers of revision 14 ignore it."""
    sums = {
        "photograph_count": sa.BigInteger,
        "support_count": sa.BigInteger,
        "surveyed_share": sa.Double,
        "inlier_count": sa.BigInteger,
        "radius_count": sa.BigInteger,
        "log_radius": sa.Double,
        "position_count": sa.BigInteger,
        **dict.fromkeys(("offset_x", "offset_y", "offset_z", "squared_offset"), sa.Double),
        **dict.fromkeys(("forward_x", "forward_y", "forward_z"), sa.Double),
    }
    op.create_table(
        "scene_count",
        sa.Column(
            "scene_id",
            sa.String(257).with_variant(sa.String(257, collation="C"), "postgresql"),
            sa.ForeignKey("scene.scene_id", ondelete="CASCADE"),
            primary_key=True,
        ),
        sa.Column("day", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("place_key", sa.String(32), primary_key=True),
        sa.Column("outcome", sa.String(32), primary_key=True),
        *(sa.Column(name, kind, nullable=False) for name, kind in sums.items()),
    )
    op.create_index("scene_count_by_day", "scene_count", ["day"])
