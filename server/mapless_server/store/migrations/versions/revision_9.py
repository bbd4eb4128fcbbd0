"""Revision 9: the schema of release 0.3.0, from that of 0.2.0, which is revision 3."""

import sqlalchemy as sa
from alembic import op

revision = "9"
down_revision = None

_SCENE_KEY = sa.String(257).with_variant(sa.String(257, collation="C"), "postgresql")
_MATCHING = sa.String(255)


def upgrade() -> None:
    """Adds tables, whose rows are deleted with the references and scenes, and a column; 0.2.0 ignores them.

    Features that a server of 0.2.0 computes of a reference with a mask are of its whole image.
    """
    op.create_table(
        "reference_pair",
        _key("first_key"),
        _key("second_key"),
        sa.Column("matching", _MATCHING, primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
        sa.Column("error_px", sa.Double()),
    )
    op.create_index("reference_pair_by_second", "reference_pair", ["second_key"])
    op.create_table(
        "reference_matching",
        _key("reference_key"),
        sa.Column("matching", _MATCHING, primary_key=True),
        sa.Column("due_time_us", sa.BigInteger()),
        sa.Column("failure_count", sa.Integer(), nullable=False, server_default=sa.text("0")),
    )
    op.create_index("reference_matching_by_due_time", "reference_matching", ["matching", "due_time_us"])
    op.create_table(
        "matching_use",
        sa.Column("matching", _MATCHING, primary_key=True),
        sa.Column("used_time_us", sa.BigInteger(), nullable=False),
    )
    op.create_table(
        "scene_calibration",
        sa.Column("scene_id", _SCENE_KEY, sa.ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
        sa.Column("kind", _MATCHING, primary_key=True),
        sa.Column("generation", sa.BigInteger()),
        sa.Column("due_time_us", sa.BigInteger(), nullable=False),
        sa.Column("failure_count", sa.Integer(), nullable=False, server_default=sa.text("0")),
        sa.Column("data", sa.LargeBinary()),
        sa.Column("sha256", sa.String(64)),
    )
    op.create_table(
        "reference_depth",
        _key("reference_key"),
        sa.Column("kind", _MATCHING, primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
    )
    op.create_table("mask", _key("reference_key"), sa.Column("data", sa.LargeBinary(), nullable=False))
    op.add_column("reference", sa.Column("mask_sha256", sa.String(64)))


def _key(name: str) -> sa.Column[str]:
    """A reference's key as a part of the primary key."""
    return sa.Column(name, sa.String(32), sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True)
