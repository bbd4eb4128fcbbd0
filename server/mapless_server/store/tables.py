"""The current schema, in types that SQLite and PostgreSQL share; `migrations` has its history."""

from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    ForeignKey,
    Index,
    Integer,
    LargeBinary,
    MetaData,
    PrimaryKeyConstraint,
    String,
    Table,
    Text,
    UniqueConstraint,
    text,
)

SCHEMA_VERSION = 16

metadata = MetaData()

# Lists are paginated by comparing ids, so both databases must compare them by code point.
_Id = String(128).with_variant(String(128, collation="C"), "postgresql")
# A column called scene_id holds the scene's key, which includes the tenant and a slash, see security.access.
_SceneKey = String(257).with_variant(String(257, collation="C"), "postgresql")
_Key = String(32)
_Sha256 = String(64)
_Matching = String(255)
_NONE_YET = text("0")

store_version = Table(
    "store_version", metadata, Column("schema_version", Integer, primary_key=True, autoincrement=False)
)

# Alembic's own, as it creates it: which of its steps were run.
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
    # Updated by every change, because counting rows is slow.
    Column("reference_count", BigInteger, nullable=False, server_default=_NONE_YET),
    # Changes are known since this generation; callers that know an earlier one read the whole scene.
    Column("first_generation", BigInteger, nullable=False, server_default=_NONE_YET),
    # See codec.py; both are null for a scene without attributes.
    Column("attributes", LargeBinary),
    Column("attributes_sha256", _Sha256),
)

# What groups scenes; by value, so that the scenes of a group are found without reading the others.
scene_label = Table(
    "scene_label",
    metadata,
    Column("scene_id", _SceneKey, ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
    Column("name", String(64), primary_key=True),
    Column("value", String(128), nullable=False),
    Index("scene_label_by_value", "name", "value"),
)

# Outlives the scene, so that a scene created again with the same id does not repeat generations.
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
    Column("geometry", LargeBinary, nullable=False),  # camera, pose and its provenance, see codec.py
    Column("geometry_sha256", _Sha256, nullable=False),
    Column("image_sha256", _Sha256, nullable=False),
    Column("feature_count", Integer, nullable=False),
    Column("create_time_us", BigInteger, nullable=False),
    # Of the scene when this reference was added or got its latest global descriptor.
    Column("generation", BigInteger, nullable=False, server_default=_NONE_YET),
    Column("mask_sha256", _Sha256),  # null without a mask
    Column("depth_sha256", _Sha256),  # null without depth
    UniqueConstraint("scene_id", "reference_id"),
    Index("reference_by_generation", "scene_id", "generation"),
    Index("reference_by_image", "scene_id", "image_sha256"),
    Index("reference_by_geometry", "scene_id", "geometry"),
)

# Tombstones: references that were deleted in the latest generations of a scene, see changes.GENERATIONS_REMEMBERED.
removed_reference = Table(
    "removed_reference",
    metadata,
    Column("scene_id", _SceneKey, ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
    Column("generation", BigInteger, primary_key=True, autoincrement=False),
    Column("reference_key", _Key, primary_key=True),
)


def _reference_key(name: str = "reference_key") -> Column[str]:
    """A reference's key, as a part of the primary key; its rows are deleted with the reference."""
    return Column(name, _Key, ForeignKey("reference.key", ondelete="CASCADE"), primary_key=True)


def _bytes() -> Column[bytes]:
    return Column("data", LargeBinary, nullable=False)


def _encoded(table: str, kind: str, length: int) -> Table:
    """A table of bytes, see codec.py, of which a reference has those of several kinds."""
    kind_column = Column(kind, String(length), primary_key=True)
    return Table(table, metadata, _reference_key(), kind_column, _bytes(), Column("sha256", _Sha256, nullable=False))


# Localized photographs that became references, see adoption.py; what vouches for them is in their geometry.
adopted_reference = Table(
    "adopted_reference",
    metadata,
    _reference_key(),
    Column("place_key", _Key, nullable=False),  # of the surveyed reference that is nearest; empty if unknown
    # Share of what photographs of its place matched that it gave; the least useful go first.
    Column("usefulness", Double, nullable=False),
    Column("adopt_time_us", BigInteger, nullable=False),
    Column("adopted_by", Text, nullable=False, server_default=text("''")),  # "DAY:HOLDER", who adopts at a place once
    Index("adopted_reference_by_place", "place_key"),
    Index("adopted_reference_by_adopt_time", "adopt_time_us"),
)

# What photographs said of a reference since it was added or restored, see adoption.py; none if there is no row.
reference_standing = Table(
    "reference_standing",
    metadata,
    _reference_key(),
    # Photographs in a row that should show what it shows, and do not; each holder of a token counts once a day.
    Column("contradiction_count", Integer, nullable=False, server_default=_NONE_YET),
    Column("contradiction_time_us", BigInteger, nullable=False, server_default=_NONE_YET),
    Column("contradicted_by", Text, nullable=False, server_default=text("''")),  # "DAY:HOLDER", separated by spaces
    # Of a surveyed one: the share of matches with surveyed references in photographs of its place, a running mean.
    Column("surveyed_share", Double),
    Column("photograph_count", Integer, nullable=False, server_default=_NONE_YET),
    # "DAY:HOLDER:PERCENT" of the last of these photographs, separated by spaces; each holder counts once a day.
    Column("surveyed_by", Text, nullable=False, server_default=text("''")),
    Column("outdate_time_us", BigInteger),  # since when the place needs a new survey; null if it does not
    Column("retire_time_us", BigInteger),  # null if it is not retired
    Column("retire_reason", String(32)),
)

# Images, masks, depth and features have tables of their own, so that listing references does not read their bytes.
image = Table("image", metadata, _reference_key(), _bytes())
mask = Table("mask", metadata, _reference_key(), _bytes())
depth = Table("depth", metadata, _reference_key(), _bytes())  # see depth_images.py
features = _encoded("features", "extractor", 128)
global_descriptor = _encoded("global_descriptor", "name", 128)
# Depth that is kept with references, see depths.py; which references are done is in reference_matching.
reference_depth = _encoded("reference_depth", "kind", 255)

# Matches of two references, see pairs.py; of the same features and options for each name in `matching`.
reference_pair = Table(
    "reference_pair",
    metadata,
    _reference_key("first_key"),
    _reference_key("second_key"),
    Column("matching", _Matching, primary_key=True),
    _bytes(),  # see codec.py
    Column("sha256", _Sha256, nullable=False),
    Column("error_px", Double),  # see method/pairs/agreement.py; null if it is not known
    Index("reference_pair_by_second", "second_key"),
)

# Progress: a reference without a row has not been begun.
reference_matching = Table(
    "reference_matching",
    metadata,
    _reference_key(),
    Column("matching", _Matching, primary_key=True),
    # When a server may claim it: the end of a claim, or of the wait after a failure; null when its pairs are stored.
    Column("due_time_us", BigInteger),
    # In a row; negative if the last one was not because the reference is damaged.
    Column("failure_count", Integer, nullable=False, server_default=_NONE_YET),
    Index("reference_matching_by_due_time", "matching", "due_time_us"),
)

# When a server last had use for a matching, to within an hour.
matching_use = Table(
    "matching_use",
    metadata,
    Column("matching", _Matching, primary_key=True),
    Column("used_time_us", BigInteger, nullable=False),
)

# What the references of a scene say of its answers, see calibrations.py; for each kind of answers.
scene_calibration = Table(
    "scene_calibration",
    metadata,
    Column("scene_id", _SceneKey, ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
    Column("kind", _Matching, primary_key=True),
    # Of the scene when its references were read, after a first calibration the number of references, negative; null
    # until one is done.
    Column("generation", BigInteger),
    # When a server may claim the scene: the end of a claim, or of the wait after a calibration or a failure.
    Column("due_time_us", BigInteger, nullable=False),
    Column("failure_count", Integer, nullable=False, server_default=_NONE_YET),
    Column("data", LargeBinary),  # see codec.py
    Column("sha256", _Sha256),
)

# Answered photographs by scene, day, place and outcome, with sums, see counts.py; no photographs, no callers.
scene_count = Table(
    "scene_count",
    metadata,
    Column("scene_id", _SceneKey, ForeignKey("scene.scene_id", ondelete="CASCADE"), primary_key=True),
    Column("day", Integer, primary_key=True, autoincrement=False),  # since 1970, UTC
    # Of a surveyed reference, which may have been deleted since; empty if unknown.
    Column("place_key", _Key, primary_key=True),
    Column("outcome", String(32), primary_key=True),
    Column("photograph_count", BigInteger, nullable=False),
    Column("support_count", BigInteger, nullable=False),  # photographs with matches of their own
    Column("surveyed_share", Double, nullable=False),
    Column("inlier_count", BigInteger, nullable=False),
    Column("radius_count", BigInteger, nullable=False),  # photographs with a radius
    Column("log_radius", Double, nullable=False),
    Column("position_count", BigInteger, nullable=False),  # photographs with a position
    # From the place's reference, world axes, and squared.
    Column("offset_x", Double, nullable=False),
    Column("offset_y", Double, nullable=False),
    Column("offset_z", Double, nullable=False),
    Column("squared_offset", Double, nullable=False),
    # Viewing directions of those whose is known.
    Column("forward_x", Double, nullable=False),
    Column("forward_y", Double, nullable=False),
    Column("forward_z", Double, nullable=False),
    Index("scene_count_by_day", "day"),
)
