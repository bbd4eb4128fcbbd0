"""A watcher receives the answers of its scene and of no other, a few at most, and none after its end."""

import asyncio
import gc
import weakref

import pytest

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import TRYING
from mapless_server.errors import Overloaded
from mapless_server.security import key_of
from mapless_server.services.watching import MAX_WATCHERS, MAX_WATCHERS_OF_TENANT, QUEUE_LENGTH, Watcher, Watchers

HALL, OTHER = key_of("default", "hall"), key_of("default", "other")
REQUEST = pb.LocalizeRequest(image=b"photograph")
REQUEST.intrinsics.width_px = 640
LIMIT_S = 10.0


def answer(inliers: int) -> pb.LocalizeResponse:
    return pb.LocalizeResponse(localization=pb.Localization(inlier_count=inliers))


def publish(watchers: Watchers, inliers: int, scene: str = HALL, debug: pb.Debug | None = None) -> None:
    watchers.publish(scene, REQUEST, answer(inliers), debug)  # type: ignore[arg-type]


async def next_of(watch: Watcher) -> pb.WatchQueriesResponse:
    return await asyncio.wait_for(watch.__anext__(), LIMIT_S)


def inliers_of(message: pb.WatchQueriesResponse) -> int:
    return int(message.answer.localization.inlier_count)


async def test_a_waiting_answer_keeps_no_more_of_the_request() -> None:
    """A part of a message keeps the whole message, so that each photograph would be in memory twice."""
    watchers = Watchers(True)
    watch = watchers.watch(HALL)
    request = pb.LocalizeRequest()
    request.CopyFrom(REQUEST)
    watchers.publish(HALL, request, answer(1), None)
    request.intrinsics.width_px = 111
    assert (await next_of(watch)).intrinsics.width_px == 640


async def test_an_oversized_photograph_is_left_out_of_the_event() -> None:
    watchers = Watchers(True, 2000)
    watch = watchers.watch(HALL)
    for size in (1000, 1999, 5):
        request = pb.LocalizeRequest(image=bytes(size))
        watchers.publish(HALL, request, answer(size), pb.Debug(error_px=[0.5] * 10))
    seen = [await next_of(watch) for _ in range(3)]
    assert [len(it.image) for it in seen] == [1000, 0, 5]
    assert [inliers_of(it) for it in seen] == [1000, 1999, 5]
    assert all(it.ByteSize() <= 2000 for it in seen)


async def test_a_slow_reader_misses_the_oldest_and_learns_how_many() -> None:
    watchers = Watchers(True)
    watch = watchers.watch(HALL)
    for i in range(QUEUE_LENGTH + 4):
        publish(watchers, i)
    seen = [await next_of(watch) for _ in range(QUEUE_LENGTH)]
    assert [inliers_of(it) for it in seen] == [4 + i for i in range(QUEUE_LENGTH)]
    assert [it.missed_count for it in seen] == [4] + [0] * (QUEUE_LENGTH - 1)


async def test_nothing_is_kept_without_watchers() -> None:
    watchers = Watchers(True)
    assert HALL not in watchers.by_scene
    publish(watchers, 1)
    watch = watchers.watch(HALL)
    assert HALL in watchers.by_scene
    assert OTHER not in watchers.by_scene
    publish(watchers, 2)
    assert inliers_of(await next_of(watch)) == 2  # not what came before it began
    await watch.aclose()
    assert HALL not in watchers.by_scene
    kept = weakref.ref(watch)
    del watch
    gc.collect()
    assert kept() is None


async def test_one_tenant_cannot_keep_the_others_from_watching() -> None:
    watchers = Watchers(True)
    for i in range(MAX_WATCHERS_OF_TENANT):
        watchers.watch(key_of("loud", f"scene-{i}"))
    with pytest.raises(Overloaded) as refused:
        watchers.watch(key_of("loud", "scene-0"))
    assert refused.value.reason == "TOO_MANY_WATCHERS"
    mine = watchers.watch(key_of("quiet", "scene-0"))
    publish(watchers, 5, key_of("loud", "scene-0"))
    publish(watchers, 6, key_of("quiet", "scene-0"))
    assert inliers_of(await next_of(mine)) == 6  # the other tenant's scene of the same name is another scene


async def test_all_tenants_share_a_limit() -> None:
    watchers = Watchers(True)
    watches = [watchers.watch(key_of(f"tenant-{i}", "hall")) for i in range(MAX_WATCHERS)]
    with pytest.raises(Overloaded) as refused:
        watchers.watch(HALL)
    assert refused.value.retry_after_s is not None
    await watches[0].aclose()
    watchers.watch(HALL)


async def test_a_watcher_does_not_learn_that_other_scenes_were_tried() -> None:
    """All that an answer among scenes can say of others, and of its own what is left."""
    watchers, among = Watchers(True), pb.LocalizeResponse(scene="scenes/hall")
    watch = watchers.watch(HALL)
    among.rejection.message = "poses in two scenes explain the photograph: one in 'hall', one in 'other'"
    for scene in ("scenes/hall", "scenes/other"):
        among.rejection.hypotheses.add(scene=scene)
        among.diagnostics.scenes.add(scene=scene)
    among.rejection.hint.message = f"Look around. {TRYING} in another scene was not finished: asking again may help."
    among.diagnostics.searched_scene_count = 2
    for rung, chosen in (("as it is", False), ("other scene", True), ("wide", False)):
        among.diagnostics.attempts.add(rung=rung, features="sift", chosen=chosen)
        among.diagnostics.ladder_cuts.add(rung=rung)
    for stage in ("retrieval", "scenes", "coarse", "sift/scenes"):
        among.diagnostics.stages.add(stage=stage)
    watchers.publish(HALL, REQUEST, among, None)
    seen = (await next_of(watch)).answer
    expected = pb.LocalizeResponse(scene="scenes/hall")
    expected.rejection.message = "several poses explain the photograph"
    expected.rejection.hypotheses.add(scene="scenes/hall")
    expected.rejection.hint.message = "Look around."
    expected.diagnostics.searched_scene_count = 1
    assert seen == expected


async def test_a_watcher_sees_all_attempts_in_a_named_scene() -> None:
    watchers, named = Watchers(True), answer(3)
    watch = watchers.watch(HALL)
    named.diagnostics.searched_scene_count = 1
    named.diagnostics.attempts.extend([pb.Attempt(rung="as it is"), pb.Attempt(rung="wide", chosen=True)])
    named.diagnostics.ladder_cuts.add(rung="mirrored")
    watchers.publish(HALL, REQUEST, named, None)
    assert (await next_of(watch)).answer == named
