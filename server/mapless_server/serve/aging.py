"""Looks now and then how the scenes with most photographs age, for metrics."""

import asyncio
import logging

from mapless_server.errors import DataLoss, NotFound, RequestError
from mapless_server.observability.scraped import SceneAge, Scraped
from mapless_server.scenes.adoption.policy import AdoptionOptions
from mapless_server.store import Store, adoption, counts
from mapless_server.store.counts import DAY_US, BusyScene
from mapless_server.store.rows import now_us

log = logging.getLogger(__name__)

FIRST_S, AGAIN_S = 10.0, 300.0
"""Time before the first look, and between two."""
DAYS = 7


async def watch_scenes(store: Store, most: int, scraped: Scraped) -> None:
    """Has metrics say how at most so many scenes age, every few minutes until it is cancelled; none after a failure."""
    pause_s = FIRST_S
    while True:
        await asyncio.sleep(pause_s)
        pause_s = AGAIN_S
        try:
            scraped.scenes = await asyncio.to_thread(ages, store, most)
        except Exception as error:  # must not end the looking
            scraped.scenes = ()
            is_away = isinstance(error, RequestError)
            log.log(logging.WARNING if is_away else logging.ERROR, "how scenes age is not known: %r", error)


def ages(store: Store, most: int) -> list[SceneAge]:
    """How the scenes with most photographs of the last days age; those that are deleted meanwhile are left out."""
    busiest = counts.busiest_scenes(store.database, now_us() // DAY_US - DAYS + 1, DAYS, most) if most else []
    return [age for it in busiest if (age := _age(store, it)) is not None]


def _age(store: Store, scene: BusyScene) -> SceneAge | None:
    try:
        adopts = store.get_attributes(scene.scene_key).adoption is not None
    except (NotFound, DataLoss):
        return None
    least = AdoptionOptions().least_photographs
    with store.database.read() as connection:
        outdated = adoption.list_outdated(connection, scene.scene_key)
    return SceneAge(
        scene.scene_key,
        scene.photograph_count,
        scene.localized_count / scene.photograph_count,
        scene.localized_before / scene.photographs_before if scene.photographs_before else None,
        counts.least_surveyed_share(store.database, scene.scene_key, least) if adopts else None,
        len(outdated),
        *counts.count_references(store.database, scene.scene_key),
    )
