"""Captured calls among several scenes: computed again in the scene that was found.

The answer is, to the last bit, the one with that scene named, so nothing else of the other scenes has to be captured:
only where the scene of the request's priors is on the Earth.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from mapless.geometry import Array
from mapless_server.engine.query import Query
from mapless_server.security import SceneKey, key_of
from mapless_server.services.capture.calls import CapturedCall, CaptureError, Response
from mapless_server.store import GroupedScene, NamedScenes, SceneAttributes


def in_found_scene(request: Any, then: Response, call: CapturedCall) -> Any:
    """The request among the scene that was found, and that of its priors; CaptureError if the answer is of several."""
    if request.scene:
        return request
    if len({it.scene for it in then.rejection.hypotheses}) > 1:
        raise CaptureError("poses in two scenes were found, and a replay computes one scene")
    if not then.scene:
        raise CaptureError("no scene had a reference")
    named = type(request)()
    named.CopyFrom(request)
    named.ClearField("scene_group")
    named.ClearField("scenes")
    named.scenes.append(then.scene)
    if request.prior_scene not in ("", then.scene):
        if call.prior_attributes is None:
            raise CaptureError(f"the priors are given in the world of {request.prior_scene}, which was not captured")
        named.scenes.append(request.prior_scene)
    return named


def in_scene_of(query: Query, call: CapturedCall) -> Query:
    """The query in the scene of a captured answer."""
    key = key_of(call.tenant, call.scene_id)
    question = next((it for it in query.scenes if it.scene_key == key), None)
    return query if question is None else replace(query.in_scene(question), scenes=(), prior_scene=None)


class ScenesOfCall:
    """The part of a store by which services find the scenes of a captured call."""

    def __init__(self, call: CapturedCall) -> None:
        self._call = call

    def get_attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """The attributes of the call's scene, as they were."""
        return self._call.attributes

    def find_scenes_named(self, scene_keys: Sequence[SceneKey]) -> NamedScenes:
        """The call's scene, and that of its priors."""
        return NamedScenes(tuple(GroupedScene(1, 0, partial(self._attributes_of, it), it) for it in scene_keys), ())

    def _attributes_of(self, scene_key: SceneKey) -> SceneAttributes:
        if scene_key == key_of(self._call.tenant, self._call.scene_id):
            return self._call.attributes
        assert self._call.prior_attributes is not None
        return self._call.prior_attributes


def no_extents(scenes: Sequence[GroupedScene]) -> Array:
    """How far references reach is not known: no scene is left out."""
    return np.full(len(scenes), np.inf)
