"""Revision 1: scenes, references, their images and features."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "1"
down_revision = None

_ID = sa.String(128).with_variant(sa.String(128, collation="C"), "postgresql")
_SCENE_KEY = sa.String(257).with_variant(sa.String(257, collation="C"), "postgresql")
_KEY = sa.String(32)
_SHA256 = sa.String(64)


def upgrade() -> None:
    """Fills an empty database."""
    op.create_table("store_version", sa.Column("schema_version", sa.Integer(), primary_key=True, autoincrement=False))
    op.create_table(
        "scene",
        sa.Column("scene_id", _SCENE_KEY, primary_key=True),
        sa.Column("create_time_us", sa.BigInteger(), nullable=False),
    )
    op.create_table(
        "scene_generation",
        sa.Column("scene_id", _SCENE_KEY, primary_key=True),
        sa.Column("generation", sa.BigInteger(), nullable=False),
    )
    op.create_table(
        "reference",
        sa.Column("key", _KEY, primary_key=True),
        sa.Column("scene_id", _SCENE_KEY, sa.ForeignKey("scene.scene_id", ondelete="CASCADE"), nullable=False),
        sa.Column("reference_id", _ID, nullable=False),
        sa.Column("geometry", sa.LargeBinary(), nullable=False),
        sa.Column("geometry_sha256", _SHA256, nullable=False),
        sa.Column("image_sha256", _SHA256, nullable=False),
        sa.Column("feature_count", sa.Integer(), nullable=False),
        sa.Column("create_time_us", sa.BigInteger(), nullable=False),
        sa.UniqueConstraint("scene_id", "reference_id"),
    )
    op.create_table(
        "image",
        sa.Column("reference_key", _KEY, sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
    )
    op.create_table(
        "features",
        sa.Column("reference_key", _KEY, sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("extractor", sa.String(128), primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("sha256", _SHA256, nullable=False),
    )
    write_version(op.get_bind(), 1)
