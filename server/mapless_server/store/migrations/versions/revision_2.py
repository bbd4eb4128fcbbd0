"""Revision 2 (expand): global descriptors, changes since a generation, and the number of references."""

import sqlalchemy as sa
from alembic import op

from mapless_server.store.migrations import write_version

revision = "2"
down_revision = "1"

_SCENE_KEY = sa.String(257).with_variant(sa.String(257, collation="C"), "postgresql")
_KEY = sa.String(32)


def upgrade() -> None:
    """Adds columns with a default, which both databases do without rewriting the rows."""
    op.add_column("scene", _number("reference_count"))
    op.add_column("scene", _number("first_generation"))
    op.add_column("reference", _number("generation"))
    op.create_index("reference_by_generation", "reference", ["scene_id", "generation"])
    op.create_table(
        "removed_reference",
        sa.Column("scene_id", _SCENE_KEY, sa.ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
        sa.Column("generation", sa.BigInteger(), primary_key=True, autoincrement=False),
        sa.Column("reference_key", _KEY, primary_key=True),
    )
    op.create_table(
        "global_descriptor",
        sa.Column("reference_key", _KEY, sa.ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
        sa.Column("name", sa.String(128), primary_key=True),
        sa.Column("data", sa.LargeBinary(), nullable=False),
        sa.Column("sha256", sa.String(64), nullable=False),
    )
    # Earlier deletions are not known: callers that know an earlier generation read the whole scene.
    op.execute(
        "UPDATE scene SET "
        "reference_count = (SELECT count(*) FROM reference WHERE reference.scene_id = scene.scene_id), "
        "first_generation = (SELECT generation FROM scene_generation "
        "WHERE scene_generation.scene_id = scene.scene_id)"
    )
    write_version(op.get_bind(), 2)


def _number(name: str) -> sa.Column[int]:
    return sa.Column(name, sa.BigInteger(), nullable=False, server_default=sa.text("0"))
