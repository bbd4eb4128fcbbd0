"""The schema: five tables and a version number, in types that SQLite and PostgreSQL share."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Column,
    Connection,
    ForeignKey,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    UniqueConstraint,
    insert,
    inspect,
    select,
)

SCHEMA_VERSION = 1

metadata = MetaData()

# Pages are cut by comparing ids, so both databases must compare them by code point.
_Id = String(128).with_variant(String(128, collation="C"), "postgresql")
# A column called scene_id holds the scene's key, of which the tenant and a slash are part, see tenancy.py.
_SceneKey = String(257).with_variant(String(257, collation="C"), "postgresql")
_Key = String(32)
_Sha256 = String(64)

store_version = Table(
    "store_version",
    metadata,
    Column("schema_version", Integer, primary_key=True, autoincrement=False),
)

scene = Table(
    "scene",
    metadata,
    Column("scene_id", _SceneKey, primary_key=True),
    Column("create_time_us", BigInteger, nullable=False),
)

# Outlives the scene, so that a scene created again under the same id does not repeat generations of its former life.
scene_generation = Table(
    "scene_generation",
    metadata,
    Column("scene_id", _SceneKey, primary_key=True),
    Column("generation", BigInteger, nullable=False),
)

reference = Table(
    "reference",
    metadata,
    Column("key", _Key, primary_key=True),
    Column("scene_id", _SceneKey, ForeignKey("scene.scene_id", ondelete="CASCADE"), nullable=False),
    Column("reference_id", _Id, nullable=False),
    Column("geometry", LargeBinary, nullable=False),  # camera and pose, see codec.py
    Column("geometry_sha256", _Sha256, nullable=False),
    Column("image_sha256", _Sha256, nullable=False),
    Column("feature_count", Integer, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
    UniqueConstraint("scene_id", "reference_id"),
)

# Images and features stand apart from `reference`, so that listing references does not drag their bytes along.
image = Table(
    "image",
    metadata,
    Column("reference_key", _Key, ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
    Column("data", LargeBinary, nullable=False),
)

features = Table(
    "features",
    metadata,
    Column("reference_key", _Key, ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
    Column("extractor", String(128), primary_key=True),
    Column("data", LargeBinary, nullable=False),  # processed camera and arrays, see codec.py
    Column("sha256", _Sha256, nullable=False),
)


def create_or_check_schema(connection: Connection) -> None:
    """Create the tables in an empty database; check that any other holds a store that this program understands.

    Raises:
        ValueError: the database holds something else, or a store of a newer program.
    """
    names = inspect(connection).get_table_names()
    if not names:
        metadata.create_all(connection)
        connection.execute(insert(store_version).values(schema_version=SCHEMA_VERSION))
        return
    found = connection.scalar(select(store_version.c.schema_version)) if store_version.name in names else None
    if found is None:
        raise ValueError("it is a database of another program")
    if found != SCHEMA_VERSION:
        raise ValueError(f"its schema has version {found}, this program knows version {SCHEMA_VERSION}")
