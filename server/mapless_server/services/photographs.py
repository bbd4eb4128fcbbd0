"""Localizes the photographs of a rig or a sequence: each alone, in one scene, with cameras that they have in common.

Among several scenes their scene is that in which one of them is localized alone: they are localized one after the
other, in the order of the request, until one is. All of them are then localized in its scene, so that the answer is the
one with that scene named. Where none is localized alone, which together they still may be, it is the scene with whose
references they have the most matches; unless one of them is ambiguous between two scenes.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

from mapless_server.engine.groups import GroupResult, PhotoGroup, after_rejection
from mapless_server.engine.query import Query, Result, SceneQuestion
from mapless_server.errors import RequestError
from mapless_server.method.judge.answer import Localization
from mapless_server.method.rejection import Rejection
from mapless_server.rpc import Call
from mapless_server.security import SceneKey

from .messages.scenes import SceneQuestions

if TYPE_CHECKING:  # services do not load what computes
    from mapless_server.engine.queue_engine import QueueEngine

Joint = TypeVar("Joint")


async def localize_group(
    engine: QueueEngine,
    queries: Sequence[Query],
    call: Call,
    list_name: str,
    pose: Callable[[Sequence[Query], Sequence[Result]], Awaitable[Joint | Rejection]],
) -> tuple[GroupResult, Joint | Rejection]:
    """Localizes the photographs of a rig or a sequence, and computes their joint `pose`.

    After a rejection the ladder says whether all of them are localized again; if that fails, the rejection stays.
    """
    in_it = await in_common_scene(engine, queries, call, list_name)
    if isinstance(in_it, Ambiguous):
        return in_it.group, in_it.rejection
    asked, group = await localize_with_cameras(engine, in_it, call, list_name)
    outcome = await _posed(asked, group, pose)
    elsewhere = after_rejection(asked, outcome) if isinstance(outcome, Rejection) else None
    if elsewhere is None:
        return group, outcome
    try:
        asked, again = await localize_with_cameras(engine, elsewhere, call, list_name)
        again = again.read_as_in(group)
        found = await _posed(asked, again, pose)
    except RequestError:  # a failed attempt at a better answer must not cost the first one
        return group, outcome
    return (group, outcome) if isinstance(found, Rejection) else (again, found)


async def in_common_scene(
    engine: QueueEngine, queries: Sequence[Query], call: Call, list_name: str
) -> Sequence[Query] | Ambiguous:
    """The queries of photographs in their scene, which is found if there are several."""
    if not queries[0].scenes:
        return queries
    groups: list[GroupResult] = []
    for query in queries:
        groups.append(await localize_photographs(engine, [query], call, list_name))
        if is_localized(groups[-1].results[0]):
            break
    scene_key = common_scene([it.results[0] for it in groups])
    if isinstance(scene_key, Rejection):
        call.note(scene=groups[-1].results[-1].scene_key)
        return Ambiguous(GroupResult.of(groups), scene_key)
    # In a thread, since converting priors takes 0.1 ms for each photograph.
    return await asyncio.to_thread(lambda: [in_scene(it, scene_key or queries[0].scene_key) for it in queries])


async def _posed(
    queries: Sequence[Query],
    group: GroupResult,
    pose: Callable[[Sequence[Query], Sequence[Result]], Awaitable[Joint | Rejection]],
) -> Joint | Rejection:
    """The joint pose; the rejection of a photograph if the camera of none of them is known."""
    if all(it.photo.exif is not None for it in queries):
        unknown = group.results[0].answer.outcome
        assert isinstance(unknown, Rejection)
        return unknown
    return await pose(queries, group.results)


async def localize_with_cameras(
    engine: QueueEngine, queries: Sequence[Query], call: Call, list_name: str
) -> tuple[Sequence[Query], GroupResult]:
    """Localizes each photograph; those without intrinsics again, with the camera that all those of one camera have.

    Returns the queries with these cameras; photographs whose camera is not known are rejected, without matches.
    """
    group = await localize_photographs(engine, queries, call, list_name)
    if all(it.photo.exif is None for it in queries):
        return queries, group
    from mapless_server.engine import group_cameras  # services do not load what computes

    cameras = group_cameras.common_cameras(queries, group.results, is_sequence=list_name == "frames")
    asked = [group_cameras.read_with(query, cameras.get(i)) for i, query in enumerate(queries)]
    again = group_cameras.read_otherwise(group.results, cameras)
    if again:
        later = await localize_photographs(engine, [asked[i] for i in again], call, list_name)
        group = group.and_then(again, later)
    results = [group_cameras.answered(it, i, cameras) for i, it in enumerate(group.results)]
    return asked, replace(group, results=tuple(results))


async def localize_photographs(
    engine: QueueEngine, queries: Sequence[Query], call: Call, list_name: str
) -> GroupResult:
    """Localizes each photograph of a rig or a sequence, and records their stages even if one of them fails.

    The photographs, of one scene, are in the request's field `list_name`. RequestError as in `PhotoGroup.localize`.
    """
    call.note(images=len(queries))
    if not queries[0].scenes:  # of several it is noted when it is found
        call.note(scene=queries[0].scene_key)
    group = PhotoGroup(engine, queries, call.caller, list_name)
    try:
        return await group.localize()
    finally:
        for records in group.records:
            call.record(records)


@dataclass(frozen=True, eq=False)
class Ambiguous:
    """The results of photographs of which one is ambiguous between two scenes, and its rejection."""

    group: GroupResult
    rejection: Rejection


def is_localized(result: Result) -> bool:
    """Whether a photograph was localized alone."""
    return isinstance(result.answer.outcome, Localization)


def common_scene(results: Sequence[Result]) -> SceneKey | Rejection | None:
    """The scene of photographs that were localized among several until one was, or why there is none.

    Args:
        results: the results, of which at most the last one is a pose.

    Returns:
        The scene; the rejection of a photograph that is ambiguous between two; None if no scene has a reference.
    """
    if is_localized(results[-1]):
        return results[-1].scene_key
    matches = Counter[SceneKey]()
    for it in results:
        rejection = it.answer.outcome
        assert isinstance(rejection, Rejection)
        if len({hypothesis.world for hypothesis in rejection.hypotheses}) > 1:
            return rejection
        if it.scene_key is not None:
            matches[it.scene_key] += sum(it.answer.reference_match_counts)
    return next((scene_key for scene_key, _ in matches.most_common(1)), None)


def in_scene(query: Query, scene_key: SceneKey) -> Query:
    """The query of a photograph in one of its scenes; its priors count there also where they left that scene out."""
    return replace(query.in_scene(question_in(query.scenes, scene_key)), scenes=(), prior_scene=None)


def question_in(scenes: Sequence[SceneQuestion], scene_key: SceneKey) -> SceneQuestion:
    """The question of one of several scenes, as if it were named."""
    if isinstance(scenes, SceneQuestions):
        return scenes.of_scene(scene_key)
    return next(it for it in scenes if it.scene_key == scene_key)
