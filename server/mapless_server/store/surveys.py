"""Surveyed references by when they were stored: what was counted at a place before does not hold for a later survey."""

from typing import Any, NamedTuple

from sqlalchemy import Connection, Row, Select, select

from mapless.geometry import RigidTransform
from mapless_server.security import SceneKey

from . import codec, queries
from .tables import adopted_reference, reference


class Surveyed(NamedTuple):
    """A surveyed reference in use: its key, when it was stored, microseconds since 1970, and its pose."""

    key: str
    create_time_us: int
    world_from_camera: RigidTransform


def list_surveyed(connection: Connection, scene_key: SceneKey, since_us: int) -> list[Surveyed]:
    """All surveyed references in use of a scene, if one of them was stored since a time; else none."""
    column = reference.c
    its: Select[Any] = select(column.key, column.create_time_us, column.geometry, column.geometry_sha256).where(
        column.scene_id == scene_key,
        column.key.not_in(select(adopted_reference.c.reference_key)),
        ~queries.is_retired(column.key),
    )
    if connection.execute(its.where(column.create_time_us >= since_us).limit(1)).first() is None:
        return []
    found = connection.execute(its).all()
    intact = [it for it in found if _is_intact(it)]
    poses = codec.decode_poses([it.geometry for it in intact])
    return [Surveyed(it.key, it.create_time_us, pose) for it, pose in zip(intact, poses, strict=True)]


def _is_intact(row: Row[Any]) -> bool:
    try:
        codec.check(row.key, row.geometry, row.geometry_sha256, "camera and pose")
    except codec.Damaged:
        return False
    return True
