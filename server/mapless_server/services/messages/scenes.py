"""The scenes among which a LocalizeRequest looks for the photograph's, and what its priors say in each of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, overload

import numpy as np

from mapless import names
from mapless.geodesy import Datum, ecef_from_geodetic, world_from_other_world
from mapless.geometry import Array, RigidTransform
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.engine.query import SceneQuestion
from mapless_server.errors import DataLoss
from mapless_server.method.bundle.moved import moved_priors
from mapless_server.method.bundle.priors import NO_PRIORS, Priors
from mapless_server.scenes import ANYWHERE, Narrowing
from mapless_server.security import SceneKey
from mapless_server.store import GroupedScene, SceneAttributes

from .priors import SETS_DATUM, check_positions, narrowing_at_place, needs_attributes, priors_from_message
from .queries import scene_key_from_name

MAX_SCENES = 64

AnyRequest = pb.LocalizeRequest | pb.LocalizeRigRequest | pb.LocalizeSequenceRequest
"""A request that names one scene, several, or their group."""

UNKNOWN = SceneAttributes()


@dataclass(frozen=True, eq=False)
class FoundScenes:
    """The scenes that a request may search, in the order in which they were found, and what is made of them once."""

    scenes: Sequence[GroupedScene]

    @cached_property
    def questions(self) -> tuple[SceneQuestion, ...]:
        """The questions of a request without priors."""
        return tuple(SceneQuestion(it.scene_key, ANYWHERE, generation=it.generation) for it in self.scenes)

    @cached_property
    def indices(self) -> Mapping[SceneKey, int]:
        """Where each scene stands among them."""
        return {it.scene_key: i for i, it in enumerate(self.scenes)}

    @cached_property
    def attributes(self) -> tuple[SceneAttributes, ...]:
        """Their attributes; of a damaged scene, which a search reports, none."""
        return tuple(map(_attributes_of, self.scenes))

    @cached_property
    def origins_in_ecef(self) -> Array:
        """Origins (N, 3) of their worlds on the Earth, metres; NaN without a datum."""
        datums = [it.datum for it in self.attributes]
        nowhere = np.full(3, np.nan)
        return np.array([nowhere if it is None else ecef_from_geodetic(it.origin) for it in datums]).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class AskedScenes:
    """The scenes in which a request looks for its photograph.

    Attributes:
        questions: the scenes where its priors allow and expect the camera, each with the priors in its world.
        prior_scene: the one in whose world a pose prior was given; None if none was.
        beyond: makes the questions of the scenes that soft priors alone leave out; None if they leave out none.
    """

    questions: Sequence[SceneQuestion]
    prior_scene: SceneKey | None = None
    beyond: Callable[[], Sequence[SceneQuestion]] | None = None


class SceneQuestions(Sequence[SceneQuestion]):
    """The questions of scenes that priors expect, and then of others that they allow, each made when it is first read.

    Made at once, those of 2,000 scenes take a third of a second.
    """

    def __init__(self, priors: _ScenePriors, expected: Sequence[int], beyond: Sequence[int]) -> None:
        self._priors = priors
        self._indices, self._expected_count = [*expected, *beyond], len(expected)
        self._made: dict[int, SceneQuestion] = {}

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, item: int) -> SceneQuestion: ...
    @overload
    def __getitem__(self, item: slice) -> Sequence[SceneQuestion]: ...
    def __getitem__(self, item: int | slice) -> SceneQuestion | Sequence[SceneQuestion]:
        places = range(len(self))[item]
        return self._at(places) if isinstance(places, int) else [self._at(it) for it in places]

    def of_scene(self, scene_key: SceneKey) -> SceneQuestion:
        """The question of one of the request's scenes as if it were named; KeyError if it is none of them."""
        return self._priors.question(self._priors.found.indices[scene_key])

    def _at(self, place: int) -> SceneQuestion:
        if place not in self._made:
            make = self._priors.question if place < self._expected_count else self._priors.question_beyond
            self._made[place] = make(self._indices[place])
        return self._made[place]


ReadExtents = Callable[[Sequence[GroupedScene]], Array]
"""Distances (N,) of the furthest references of scenes from the origins of their worlds, metres; infinite if unknown."""


def _attributes_of(scene: GroupedScene) -> SceneAttributes:
    try:
        return scene.attributes
    except DataLoss:
        return UNKNOWN


def names_several(request: AnyRequest) -> bool:
    """Whether a request gives several scenes instead of one; FieldError if it gives both, or none."""
    message: Any = request
    is_given = {"scene": request.scene, "scenes": request.scenes, "scene_group": message.HasField("scene_group")}
    given = [name for name, is_there in is_given.items() if is_there]
    if len(given) > 1:
        rule = f"exactly one of {', '.join(is_given)} is required"
        raise FieldError(given[1], f"must not be given together with {given[0]}: {rule}")
    if not given:
        raise FieldError("scene", "must be scenes/{scene}, got ''; or give scenes or scene_group instead")
    return given != ["scene"]


def scene_keys_from_message(request: AnyRequest, tenant: str) -> list[SceneKey]:
    """Keys of the scenes that a request lists; FieldError if there are too many, or a name is wrong or repeated."""
    if len(request.scenes) > MAX_SCENES:
        raise FieldError("scenes", f"must be at most {MAX_SCENES}, are {len(request.scenes)}; scene_group has no limit")
    keys: dict[SceneKey, None] = {}
    for i, name in enumerate(request.scenes):
        key = scene_key_from_name(name, f"scenes[{i}]", tenant)
        if key in keys:
            raise FieldError(f"scenes[{i}]", f"{names.shown(name)} is repeated")
        keys[key] = None
    return list(keys)


def questions_from_message(
    request: pb.LocalizeRequest, found: FoundScenes, tenant: str, extents: ReadExtents
) -> AskedScenes:
    """The scenes to search for a request's photograph; FieldError names a wrong field.

    Scenes that are further away than the priors allow or expect are left out, as far as `extents` are known.
    """
    allowed, count, prior_scene = _allowed(request, found, tenant, extents)
    beyond = (lambda: allowed[count:]) if count < len(allowed) else None
    return AskedScenes(allowed[:count], prior_scene, beyond)


def allowed_from_message(
    request: pb.LocalizeRequest, found: FoundScenes, tenant: str, extents: ReadExtents
) -> Sequence[SceneQuestion]:
    """The same with the scenes beyond; with priors they are `SceneQuestions`."""
    return _allowed(request, found, tenant, extents)[0]


def _allowed(
    request: pb.LocalizeRequest, found: FoundScenes, tenant: str, extents: ReadExtents
) -> tuple[Sequence[SceneQuestion], int, SceneKey | None]:
    """The scenes that the priors allow, how many of them they expect, and the scene of a pose prior."""
    check_positions(request)
    if request.references:
        raise FieldError("references", "must be empty where the server finds the scene: give scene with references")
    in_world, on_earth = _parts_of(request)
    prior_index = _prior_scene(request, found, tenant, in_world)
    if not (in_world.ListFields() or on_earth.ListFields()):
        return found.questions, len(found.questions), None
    priors = _ScenePriors.of(found, in_world, prior_index, on_earth)
    reached, beyond = priors.reached(extents)
    has_pose = request.HasField("pose_prior")
    prior_scene = None if prior_index is None or not has_pose else found.scenes[prior_index].scene_key
    return SceneQuestions(priors, reached, beyond), len(reached), prior_scene


def _parts_of(request: pb.LocalizeRequest) -> tuple[pb.LocalizeRequest, pb.LocalizeRequest]:
    """The priors that are given in a world, and those that hold in every scene that is placed."""
    in_world, on_earth = pb.LocalizeRequest(), pb.LocalizeRequest()
    for name in ("position_prior", "heading_prior", "gravity_prior", "pose_prior", "geo_position_prior"):
        if request.HasField(name):
            part = pb.LocalizeRequest()
            getattr(part, name).CopyFrom(getattr(request, name))
            (on_earth if needs_attributes(part) else in_world).MergeFrom(part)
    return in_world, on_earth


def _prior_scene(
    request: pb.LocalizeRequest, found: FoundScenes, tenant: str, in_world: pb.LocalizeRequest
) -> int | None:
    """Index of the scene in whose world priors are given; FieldError if it is missing, or none of the scenes."""
    if not request.prior_scene:
        if not in_world.ListFields():
            return None
        if len(found.scenes) == 1:
            return 0
        given = in_world.ListFields()[0][0].name
        raise FieldError("prior_scene", f"is required with {given}: one of several scenes, in whose world it is given")
    key = scene_key_from_name(request.prior_scene, "prior_scene", tenant)
    index = found.indices.get(key)
    if index is None:
        given = names.shown(request.prior_scene)
        raise FieldError("prior_scene", f"must be one of the request's scenes, {given} is not")
    return index


@dataclass(frozen=True, eq=False)
class _ScenePriors:
    """The priors of one request in each of several scenes.

    Attributes:
        found: the scenes.
        given: limits and priors as they are in the world of one of them.
        prior_index: index of that scene; None if nothing is given so.
        on_earth: a geographic position and gravity, which hold in every scene with a datum or a direction of down.
    """

    found: FoundScenes
    given: tuple[Narrowing, Priors]
    prior_index: int | None
    on_earth: pb.LocalizeRequest

    @staticmethod
    def of(
        found: FoundScenes, in_world: pb.LocalizeRequest, prior_index: int | None, on_earth: pb.LocalizeRequest
    ) -> _ScenePriors:
        """Reads the priors; FieldError if a value is wrong, or no scene can use one that holds on the Earth."""
        it = _ScenePriors(found, priors_from_message(in_world, UNKNOWN), prior_index, on_earth)
        if on_earth.HasField("geo_position_prior") and not np.isfinite(found.origins_in_ecef).any():
            message = f"needs a scene with a datum, and none of these has one {SETS_DATUM}"
            raise FieldError("geo_position_prior", message)
        if on_earth.HasField("gravity_prior"):
            known = next((its for its in found.attributes if its.down() is not None), None)
            if known is None:
                message = "is required: no scene has a datum or a direction of down"
                raise FieldError("gravity_prior.down_in_world", message)
            priors_from_message(pb.LocalizeRequest(gravity_prior=on_earth.gravity_prior), known)
        return it

    def question(self, index: int) -> SceneQuestion:
        """The question of one scene."""
        scene, known = self.found.scenes[index], self.found.attributes[index]
        narrowing, priors = self._given_in(index)
        is_converted = index != self.prior_index and (bool(priors) or not narrowing.is_empty)
        on_earth = pb.LocalizeRequest()
        on_earth.CopyFrom(self.on_earth)
        if known.datum is None:
            on_earth.ClearField("geo_position_prior")
        if known.down() is None:
            on_earth.ClearField("gravity_prior")
        _, added = priors_from_message(on_earth, known)
        if added:
            gravity = added.gravity or priors.gravity
            priors = replace(priors, position=added.position or priors.position, gravity=gravity)
            narrowing = replace(Narrowing.of(priors), position=narrowing.position, heading=narrowing.heading)
        used = known if is_converted or added else None
        return SceneQuestion(scene.scene_key, narrowing, priors, used, scene.generation)

    def _given_in(self, index: int) -> tuple[Narrowing, Priors]:
        """Converts what is given in one scene's world to another's; nothing if one of them has no datum."""
        if index == self.prior_index:
            return self.given
        datum, other = self.found.attributes[index].datum, self._prior_datum
        if datum is None or other is None:
            return ANYWHERE, NO_PRIORS
        return _moved(*self.given, world_from_other_world(datum, other))

    @property
    def _prior_datum(self) -> Datum | None:
        return None if self.prior_index is None else self.found.attributes[self.prior_index].datum

    def question_beyond(self, index: int) -> SceneQuestion:
        """The question of one scene where soft priors do not expect the camera: its references are chosen anywhere."""
        question = self.question(index)
        return replace(question, narrowing=question.narrowing.limits)

    def reached(self, extents: ReadExtents) -> tuple[Sequence[int], Sequence[int]]:
        """Indices of the scenes with references where the priors expect the camera, and of others where they allow it.

        If they expect it in none that has a datum, it may be in all where they allow it.
        """
        # Moved, by nothing, the given ones are as uncertain as they are in other worlds.
        given = _moved(*self.given, RigidTransform.identity())[0]
        places = [] if self._prior_datum is None else [(given, self._prior_datum)]
        if self.on_earth.HasField("geo_position_prior"):
            places.append(narrowing_at_place(self.on_earth.geo_position_prior, "geo_position_prior"))
        count = len(self.found.scenes)
        if not places:
            return range(count), ()
        placed = np.flatnonzero(np.isfinite(self.found.origins_in_ecef[:, 0]))
        origins, radii_m = self.found.origins_in_ecef[placed], extents(self.found.scenes)[placed]
        expected, allowed = np.ones((2, len(placed)), bool)
        for narrowing, datum in places:
            in_world = datum.ecef_from_world().inverse().apply(origins)
            allowed &= narrowing.limits.reaches(in_world, radii_m)
            expected &= narrowing.reaches(in_world, radii_m)
        if not expected.any():
            expected = allowed if allowed.any() else np.ones(len(placed), bool)
        reached = np.delete(np.arange(count), placed[~expected]).tolist()
        return reached, placed[allowed & ~expected].tolist()


def _moved(narrowing: Narrowing, priors: Priors, other_from_world: RigidTransform) -> tuple[Narrowing, Priors]:
    """Limits and priors in another world, in which theirs has a pose."""
    priors, sphere, cone = moved_priors(priors, other_from_world), narrowing.position, narrowing.heading
    position = sphere and replace(sphere, position=other_from_world.apply(sphere.position))
    heading = cone and replace(cone, forward=other_from_world.rotation @ cone.forward)
    return replace(Narrowing.of(priors), position=position, heading=heading), priors
