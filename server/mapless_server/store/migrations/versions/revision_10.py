"""Revision 10: references are found by their image, and by their camera and pose."""

from alembic import op

revision = "10"
down_revision = "9"


def upgrade() -> None:
    """Adds indices, which servers of revision 9 keep up to date without knowing them."""
    op.create_index("reference_by_image", "reference", ["scene_id", "image_sha256"])
    op.create_index("reference_by_geometry", "reference", ["scene_id", "geometry"])
