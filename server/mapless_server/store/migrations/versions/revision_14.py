"""Revision 14: references that were adopted, and what photographs said of references."""

import sqlalchemy as sa
from alembic import op

revision = "14"
down_revision = "13"


def upgrade() -> None:
    """Adds two tables, whose rows are deleted with the references; servers of revision 13 ignore them."""

    def key() -> sa.Column[str]:
        return sa.Column(
            "reference_key", sa.String(32), sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True
        )

    op.create_table(
        "adopted_reference",
        key(),
        sa.Column("place_key", sa.String(32), nullable=False),
        sa.Column("usefulness", sa.Double, nullable=False),
        sa.Column("adopt_time_us", sa.BigInteger, nullable=False),
    )
    op.create_index("adopted_reference_by_place", "adopted_reference", ["place_key"])
    op.create_index("adopted_reference_by_adopt_time", "adopted_reference", ["adopt_time_us"])
    none_yet = sa.text("0")
    op.create_table(
        "reference_standing",
        key(),
        sa.Column("contradiction_count", sa.Integer, nullable=False, server_default=none_yet),
        sa.Column("contradiction_time_us", sa.BigInteger, nullable=False, server_default=none_yet),
        sa.Column("contradicted_by", sa.Text, nullable=False, server_default=sa.text("''")),
        sa.Column("surveyed_share", sa.Double),
        sa.Column("photograph_count", sa.Integer, nullable=False, server_default=none_yet),
        sa.Column("retire_time_us", sa.BigInteger),
        sa.Column("retire_reason", sa.String(32)),
    )
