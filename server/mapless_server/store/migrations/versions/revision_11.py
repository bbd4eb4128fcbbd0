"""Revision 11: features of photographs that EXIF turns are those of the upright raster."""

import sqlalchemy as sa
from alembic import op

from mapless_server.images import Upright, upright_of

revision = "11"
down_revision = "10"

_DERIVED = (
    ("features", "reference_key"),
    ("global_descriptor", "reference_key"),
    ("reference_pair", "first_key"),
    ("reference_pair", "second_key"),
    ("reference_matching", "reference_key"),
)
"""Tables of what is computed from features, and their columns of references."""


def upgrade() -> None:
    """Deletes what was computed from such photographs as they are stored; it is computed again when it is needed.

    Servers of revision 10 that run beside those of this one compute some of it as before.
    """
    connection = op.get_bind()
    image = sa.table("image", sa.column("reference_key"), sa.column("data"))
    keys = connection.scalars(sa.select(image.c.reference_key)).all()
    for key in keys:
        (data,) = connection.execute(sa.select(image.c.data).where(image.c.reference_key == key)).one()
        if upright_of(bytes(data)) == Upright():
            continue
        for name, column in _DERIVED:
            table = sa.table(name, sa.column(column))
            connection.execute(sa.delete(table).where(table.c[column] == key))
