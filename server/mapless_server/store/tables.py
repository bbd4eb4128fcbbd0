"""The schema as it is now, in types that SQLite and PostgreSQL share; migrations/ has how it came about."""

from __future__ import annotations

from sqlalchemy import (
    BigInteger,
    Column,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    PrimaryKeyConstraint,
    String,
    Table,
    UniqueConstraint,
    text,
)

SCHEMA_VERSION = 3

metadata = MetaData()

# Pages are cut by comparing ids, so both databases must compare them by code point.
_Id = String(128).with_variant(String(128, collation="C"), "postgresql")
# A column called scene_id holds the scene's key, of which the tenant and a slash are part, see tenancy.py.
_SceneKey = String(257).with_variant(String(257, collation="C"), "postgresql")
_Key = String(32)
_Sha256 = String(64)
_NONE_YET = text("0")

store_version = Table(
    "store_version",
    metadata,
    Column("schema_version", Integer, primary_key=True, autoincrement=False),
)

# Alembic's own, as it makes it: which of its steps were run.
alembic_version = Table(
    "alembic_version",
    metadata,
    Column("version_num", String(32), nullable=False),
    PrimaryKeyConstraint("version_num", name="alembic_version_pkc"),
)

scene = Table(
    "scene",
    metadata,
    Column("scene_id", _SceneKey, primary_key=True),
    Column("create_time_us", BigInteger, nullable=False),
    # Counted by every change: counting rows takes as long as there are rows.
    Column("reference_count", BigInteger, nullable=False, server_default=_NONE_YET),
    # Changes are known since this generation: who knows the scene as of an earlier one reads it as a whole.
    Column("first_generation", BigInteger, nullable=False, server_default=_NONE_YET),
    # What is known of it as a whole, see codec.py; both are null where that is nothing.
    Column("attributes", LargeBinary),
    Column("attributes_sha256", _Sha256),
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
    # Of the scene when this reference was added, or got its latest global descriptor.
    Column("generation", BigInteger, nullable=False, server_default=_NONE_YET),
    UniqueConstraint("scene_id", "reference_id"),
    Index("reference_by_generation", "scene_id", "generation"),
)

# References that were deleted in the latest generations of a scene, see GENERATIONS_REMEMBERED.
removed_reference = Table(
    "removed_reference",
    metadata,
    Column("scene_id", _SceneKey, ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
    Column("generation", BigInteger, primary_key=True, autoincrement=False),
    Column("reference_key", _Key, primary_key=True),
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

global_descriptor = Table(
    "global_descriptor",
    metadata,
    Column("reference_key", _Key, ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True),
    Column("name", String(128), primary_key=True),
    Column("data", LargeBinary, nullable=False),  # see codec.py
    Column("sha256", _Sha256, nullable=False),
)
