"""Damage to stored data, as by a bad disk."""

from pathlib import Path

from mapless_server.security import SceneKey
from mapless_server.store import Store

PAGE_BYTES = 4096
_COLUMN = {
    "image": "UPDATE image SET data = zeroblob(64) WHERE reference_key = ?",
    "features": "UPDATE features SET data = zeroblob(64) WHERE reference_key = ?",
    "descriptor": "UPDATE global_descriptor SET data = zeroblob(64) WHERE reference_key = ?",
    "pose": "UPDATE reference SET geometry = zeroblob(64) WHERE key = ?",
}


def damage(store: Store, scene_key: SceneKey, reference_id: str, what: str) -> None:
    """Damages the "image", the "features", the "descriptor" or the "pose" of a reference, by the store's back door."""
    with store.database.write() as connection:
        key = connection.exec_driver_sql(
            "SELECT key FROM reference WHERE scene_id = ? AND reference_id = ?", (scene_key, reference_id)
        ).scalar_one()
        assert connection.exec_driver_sql(_COLUMN[what], (key,)).rowcount > 0


def lose_page_with(file: Path, content: bytes) -> None:
    """Zeroes the page of a database in which some content begins, and with it a link to the next page."""
    at = file.read_bytes().find(content)
    assert at > 0
    with file.open("r+b") as stream:
        stream.seek(at // PAGE_BYTES * PAGE_BYTES)
        stream.write(bytes(PAGE_BYTES))
