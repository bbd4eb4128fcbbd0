"""The search for a photograph's pose: what the attempts so far have found, and the attempt that is computed."""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from mapless_server.engine.photo_views import QueryViews
from mapless_server.errors import RequestError
from mapless_server.method.features.views import Matches, PosedView, View
from mapless_server.method.judge.hypothesis import Attempt, Where, first_attempt
from mapless_server.method.options import ChosenCamera, StageContext
from mapless_server.method.rejection import PoseHypothesis
from mapless_server.scenes import Choice
from mapless_server.scenes.later import FEATURES, Pending
from mapless_server.scheduling import Job, StageResult, Step, processor_s
from mapless_server.store import SceneAttributes, SceneState

from .query import PREPARE, REFINE, CutReason, LadderCut, MissingEvidence, Query, Result, Tried
from .scene_group import SceneGroup, begun_scenes
from .source import ReferenceSource

if TYPE_CHECKING:  # services need not load what computes
    from mapless_server.method.judge.decide import Verdict
    from mapless_server.method.judge.hypothesis import Found
    from mapless_server.method.pipeline import Coarse, Prepared

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Material:
    """A photograph and its references, described with the same features: what attempts of one basis are computed from.

    Attributes:
        basis: the basis of the attempts that it serves.
        views: the photograph in their raster.
        view: its features.
        references: the references that are used, in order.
        scene: the scene as it was when they were read.
        attributes: its attributes, as far as they count for the query.
        choice: how they were chosen; None if the caller named them.
        query_matches: matches of the photograph with each reference, if they were chosen by these.
        is_strong: whether these are to be those of a network, as far as nearest neighbours find few.
        unmatched: indices of the references that the network has still to match, each in a step of its own, so that a
            busy server computes for other callers in between.
        rematched: indices of those that it has matched.
        camera: the camera of the view that was chosen by these matches; None if the photograph came with intrinsics.
    """

    basis: Attempt
    views: QueryViews
    view: View
    references: tuple[PosedView, ...]
    scene: SceneState
    attributes: SceneAttributes
    choice: Choice | None = None
    query_matches: tuple[Matches, ...] | None = None
    is_strong: bool = False
    unmatched: tuple[int, ...] = ()
    rematched: tuple[int, ...] = ()
    camera: ChosenCamera | None = None

    def serves(self, attempt: Attempt) -> bool:
        """Whether an attempt is computed from it."""
        return attempt.basis == self.basis and attempt.matching.is_strong == self.is_strong

    @property
    def is_searched(self) -> bool:
        """Whether the scene has references to choose from."""
        return self.choice is not None and bool(self.choice.descriptor)

    @property
    def missing(self) -> str:
        """Says why there are no references."""
        if self.choice is not None and self.choice.references:
            return "what is stored of the references that resemble the photograph is damaged"
        return "no reference is where the prior says" if self.is_searched else "the scene has no references"

    def of_place(self, place: PoseHypothesis, basis: Attempt) -> Material:
        """The same with the references of one place alone."""
        kept = [i for i, it in enumerate(self.references) if it.name in place.references]
        matches = None if self.query_matches is None else tuple(self.query_matches[i] for i in kept)
        references = tuple(self.references[i] for i in kept)
        return replace(
            self, basis=basis, references=references, query_matches=matches, is_strong=False, unmatched=(), rematched=()
        )


_COUNTS = (2, 5, 10, 20, 64)
"""Queries with about as many references cost about as much."""

SKIPPED, DOUBTFUL = "skipped", "doubtful"
"""Outcomes of an attempt that could not differ from an earlier one, and of tracking that left a doubt."""

UNFINISHED = "unfinished", "failed", "out_of_memory"
"""Outcomes of an attempt that did not come to an end."""


LACKING_S = 2.7
"""Longest time of a query in whose scene references lack features: so its answer comes within 3 s. The first attempt
with further features that are stored, or were made in time, may take until the caller's deadline all the same."""

MAKE_S = 1.5
"""For so long since its begin, such a query makes what they lack."""


@dataclass(frozen=True, eq=False)
class Search:
    """The state of a query between its stages.

    Attributes:
        query: the query.
        source: source of the references.
        views: the photograph.
        deadline_s: time after which the answer is useless, by `time.monotonic`.
        on_better: called in the computing thread with each accepted answer that is better than the ones before, and
            with a coarse one where the query allows it, while further attempts follow.
        rung: name of the rung that the attempt is on.
        attempt: the attempt that is computed.
        before: the last attempt that had a result; None before the first one.
        tried: all attempts that have ended.
        found: their results; those that had none left out.
        materials: for each result, what it was computed from.
        attempts: how each attempt ended.
        cuts: attempts that were left out, or not finished, for another reason than what the photograph shows.
        is_cut_at: whether the caller gets cheap rungs only, though one follows that is not, of a name and features.
        verdict: what is answered by now; None before the first result.
        own: of several scenes, the verdict of the present one's attempts alone; else the same.
        group: the scenes, if the query is of several.
        parked: the searches in others of these, by their ranks, and the time of their stages.
        begun_s: when the query came, by `time.monotonic`.
        start_s: when the attempt began to wait for the queue, by `time.monotonic`.
        give_up_s: time after which the verdict so far is the answer, if the attempt has no result by then.
        pending: what the background has still to make in the scene; None before a doubt asks for it.
        listings: how often the scene was listed in the attempt.
        context: cancels and times the computation from the photograph and references of the attempt.
        spent_s: time of each stage of the computations before it.
        computed_s, processor_s: time and processor time of the attempt until its present stage.
        stage_start_s, stage_processor_s: the time and the thread's processor time when the present stage began; None
            between stages.
        material: the photograph and references; None until they are chosen.
        prepared: the photographs' matches, for the stage `coarse`.
        coarse: the reconstruction that attempts of the material's basis begin with.
        angles_deg: by how much to turn the photograph, see `Situation`.
        agreement: the largest that its matches with references have shown so far, see `choosing` and `features.rolls`.
    """

    query: Query
    source: ReferenceSource
    views: QueryViews
    deadline_s: float
    on_better: Callable[[Result], object] | None = None
    rung: str = ""
    attempt: Attempt = field(default_factory=Attempt)
    before: Attempt | None = None
    tried: tuple[Attempt, ...] = ()
    found: tuple[Found, ...] = ()
    materials: tuple[Material, ...] = ()
    attempts: tuple[Tried, ...] = ()
    cuts: tuple[LadderCut, ...] = ()
    is_cut_at: Callable[[str, str], bool] = lambda rung, features: False
    verdict: Verdict | None = None
    own: Verdict | None = None
    group: SceneGroup | None = None
    parked: Mapping[int, tuple[Search, Mapping[str, float]]] = field(default_factory=dict)
    begun_s: float = field(default_factory=time.monotonic)
    start_s: float = field(default_factory=time.monotonic)
    give_up_s: float = math.inf
    pending: tuple[Pending, ...] | None = None
    listings: int = 1
    context: StageContext = field(default_factory=StageContext)
    spent_s: Mapping[str, float] = field(default_factory=dict)
    computed_s: float = 0.0
    processor_s: float = 0.0
    stage_start_s: float | None = None
    stage_processor_s: float | None = None
    material: Material | None = None
    prepared: Prepared | None = None
    coarse: Coarse | None = None
    angles_deg: tuple[float, ...] = ()
    agreement: float = 0.0

    @classmethod
    def begin(
        cls,
        query: Query,
        source: ReferenceSource,
        views: QueryViews,
        deadline_s: float,
        on_better: Callable[[Result], object] | None = None,
    ) -> Search:
        """The search at its first attempt."""
        group, can_be_tracked = None, query.can_be_tracked
        if query.scenes:
            group = SceneGroup(query, views)
            query, can_be_tracked = query.in_prior_scene()
        rung, attempt = first_attempt(can_be_tracked)
        return cls(query, source, views, deadline_s, on_better, rung, attempt, group=group)

    def but(self, **changes: object) -> Search:
        """A copy with these values: `dataclasses.replace` in a tenth of its time, a dozen times a query.

        TypeError for a name that is no field.
        """
        if not changes.keys() <= self.__dict__.keys():
            raise TypeError(f"a search has no {', '.join(sorted(changes.keys() - self.__dict__.keys()))}")
        copy = object.__new__(Search)
        copy.__dict__.update(self.__dict__, **changes)
        return copy

    @property
    def attributes(self) -> SceneAttributes:
        """The attributes of the scene that the attempt's references are of."""
        return (self.material or self.materials[-1]).attributes

    @property
    def may_be_elsewhere(self) -> bool:
        """Whether references elsewhere would be chosen without soft priors."""
        can_be = self.material is not None and self.material.choice is not None and not self.query.is_part
        return can_be and self.query.narrowing.has_likely

    def knowing_pending(self) -> Search:
        """The search with what the background has still to make in the scene.

        Nothing is known of that while the store is away or after the scene was deleted: the answer is given without it.
        """
        if self.pending is not None:
            return self
        scene_key, pending = self.query.scene_key, tuple[Pending, ...]()
        try:
            pending = tuple(self.source.pending(scene_key))
        except RequestError as error:
            log.warning("what the background has to make in scene %s is not known: %s", scene_key, error)
        return self.but(pending=pending)

    def ended(self, outcome: str, features: str, has_result: bool = False) -> Search:
        """The search after the present attempt, which took the time since it began."""
        now = self.paused(self)
        ended = Tried(self.rung, features, outcome, now.computed_s, now.processor_s, self.agreement)
        before = self.attempt if has_result else self.before
        tried = (*self.tried, self.attempt)
        return self.but(before=before, tried=tried, attempts=(*self.attempts, ended))

    def to(self, rung: str, attempt: Attempt, give_up_s: float, features: str) -> Search:
        """The search at another attempt; `features` are those of the one before."""
        if attempt.scene != self.attempt.scene:
            return self.in_scene(attempt.scene, features).to(rung, attempt, give_up_s, features)
        is_other = attempt.basis != self.attempt.basis or self.coarse is None
        return self.but(
            rung=rung,
            attempt=attempt,
            give_up_s=give_up_s,
            start_s=time.monotonic(),
            computed_s=0.0,
            processor_s=0.0,
            stage_start_s=None,
            stage_processor_s=None,
            listings=1,
            context=self._next_context() if is_other else self.context,
            spent_s=self._own_seconds(features) if is_other else self.spent_s,
        )

    def in_scene(self, rank: int, features: str) -> Search:
        """The search in one of several scenes, where it was left or at its begin; this one is parked.

        It is the one that it would be with the scene named: it has its own attempts, and so its own doubts. `features`
        are those of the present attempt.
        """
        if rank == self.attempt.scene:
            return self
        parked = {**self.parked, self.attempt.scene: (self, self._own_seconds(features))}
        there = parked.pop(rank)[0] if rank in parked else self.entered(rank)
        return there.but(
            group=self.group,
            parked=parked,
            tried=self.tried,
            attempts=self.attempts,
            cuts=self.cuts,
            verdict=self.verdict,
        )

    def entered(self, rank: int) -> Search:
        """The search at its begin in one of several scenes."""
        assert self.group is not None
        return self.but(
            query=self.group.query.in_scene(self.group.ranking[rank].question),
            views=self.group.views,
            attempt=Attempt(scene=rank),
            before=None,
            found=(),
            materials=(),
            own=None,
            pending=None,
            context=StageContext(self.context.check),
            spent_s={},
            material=None,
            prepared=None,
            coarse=None,
            angles_deg=(),
            agreement=0.0,
        )

    @property
    def searches(self) -> list[Search]:
        """The searches in all scenes that were tried, in the order of their ranks."""
        there = {rank: it for rank, (it, _) in self.parked.items()} | {self.attempt.scene: self}
        return [it for _, it in sorted(there.items())]

    def _next_context(self) -> StageContext:
        """The context of an attempt with other photographs or references.

        Before a first result, all is made that references lack; after it, as much as there is time for.
        """
        make_until_s = self.begun_s + MAKE_S if self.found else math.inf
        return StageContext(self.context.check, make_until_s=make_until_s, lacking=self.context.lacking)

    @property
    def lacking_until_s(self) -> float:
        """Time until which references' evidence is waited for: its deadline, or earlier where they lack features.

        Matches that they lack are left out, or made with the query, and need no such limit.
        """
        lacks = self.context.lacking or any(it.work == FEATURES for it in self.pending or ())
        return min(self.deadline_s, self.begun_s + LACKING_S) if self.found and lacks else self.deadline_s

    @property
    def ends_s(self) -> float:
        """Time by which it ends: its deadline, until an attempt with further features has had a result."""
        return self.lacking_until_s if any(it.attempt.features for it in self.found) else self.deadline_s

    def reason_at(self, until_s: float) -> CutReason:
        """The reason of a cut at a time until which an attempt may take: what references lack, or the deadline."""
        is_lacking = until_s < self.deadline_s and until_s <= self.give_up_s
        return CutReason.FEATURES_MISSING if is_lacking else CutReason.NO_TIME

    @property
    def missing(self) -> tuple[MissingEvidence, ...]:
        """Evidence that references lack for further attempts: found lacking first, then what waits in the scene."""
        if not self.found:
            return ()
        waiting = {(it.work, it.name): it.reference_count for it in self.pending or ()}
        lacking = dict(self.context.lacking)  # which a stage may change meanwhile
        found = Counter((kind, name) for kind, name, _ in lacking)
        made = Counter((kind, name) for (kind, name, _), is_made in lacking.items() if is_made)
        names = dict.fromkeys([*found, *waiting])
        return tuple(MissingEvidence(*it, max(found[it], waiting.get(it, 0)), made[it]) for it in names)

    def cut(self, rung: str, features: str, reason: CutReason, unmatched: int = 0) -> Search:
        """The search with another cut of the ladder."""
        return self.but(cuts=(*self.cuts, LadderCut(rung, features, reason, unmatched)))

    @property
    def gets_cheap_rungs(self) -> bool:
        """Whether the ladder was cut to its cheap rungs."""
        return any(it.reason is CutReason.CALLER_FAILS for it in self.cuts)

    def seconds(self, features: str) -> dict[str, float]:
        """Time of every stage so far; those of the present photographs after the first ones begin with `features`."""
        seconds = self._own_seconds(features)
        for _, parked in self.parked.values():
            for name, spent_s in parked.items():
                seconds[name] = seconds.get(name, 0.0) + spent_s
        return seconds

    def _own_seconds(self, features: str) -> dict[str, float]:
        """The same of the present one of several scenes."""
        is_first = not any(it.basis != self.attempt.basis for it in self.tried if it.where is not Where.NEAR_PRIOR)
        seconds = dict(self.spent_s)
        for name, spent_s in dict(self.context.stage_seconds).items():  # which a stage may change meanwhile
            name = name if is_first else f"{features}/{name}"
            seconds[name] = seconds.get(name, 0.0) + spent_s
        return seconds

    def resumed(self) -> Search:
        """The search in a stage, in the thread that computes it."""
        return self.but(stage_start_s=time.monotonic(), stage_processor_s=processor_s())

    def paused(self, stage: Search) -> Search:
        """The search after a stage of its attempt, or of another one, whose time is then not its own."""
        is_other = (stage.rung, stage.attempt.scene) != (self.rung, self.attempt.scene)
        if stage.stage_start_s is None or stage.stage_processor_s is None or is_other:
            return self.but(stage_start_s=None, stage_processor_s=None)
        return self.but(
            computed_s=stage.computed_s + time.monotonic() - stage.stage_start_s,
            processor_s=stage.processor_s + processor_s() - stage.stage_processor_s,
            stage_start_s=None,
            stage_processor_s=None,
        )

    @property
    def kind(self) -> str:
        """Kind of its jobs; jobs of one kind take about the same time."""
        count = len(self.query.reference_ids)
        size = next((it for it in _COUNTS if count <= it), _COUNTS[-1])
        kind = f"{self.rung}, tier {self.attempt.features}, {'chosen' if self.query.chooses else f'up to {size}'}"
        return f"{kind}, among scenes" if self.chooses_scenes else kind

    @property
    def chooses_scenes(self) -> bool:
        """Whether the scenes are still to be chosen in which the photograph is looked for."""
        return self.group is not None and not self.group.ranking and self.attempt.where is not Where.NEAR_PRIOR

    @property
    def is_at_begin(self) -> bool:
        """Whether nothing was tried, or nothing in the present one of several scenes."""
        if self.group is None or self.attempt.where is Where.NEAR_PRIOR:
            return not self.tried
        return self.attempt.scene not in begun_scenes(self.tried)

    @property
    def first_step(self) -> Step[Search]:
        """The first step of the attempt: what the attempts before have computed is not computed again."""
        material, attempt = self.material, self.attempt
        is_ready = self.coarse is not None and material is not None and material.serves(attempt)
        return self.step(REFINE if is_ready else PREPARE)

    def step(self, stage: str, bucket: str = "") -> Step[Search]:
        """A step of the attempt."""
        return Step(stage, self.kind, bucket or self.kind, self)


SearchStep = Step[Search]
SearchJob = Job[Search, Result]
SearchResult = StageResult[Search, Result]
"""The queue's types with a query's payload and value."""
