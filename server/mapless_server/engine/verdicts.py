"""From what attempts have found to the result for the caller: options and limits of the scene, hints, times."""

from collections.abc import Sequence
from dataclasses import replace

from mapless_server.engine.search import Material
from mapless_server.method import ladder
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.coarse.geometric import GeometricReconstructor
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.judge.hints import hinted
from mapless_server.method.judge.hypothesis import Attempt, Doubt, Found, Where
from mapless_server.method.judge.judge import trust_in_scene
from mapless_server.method.judge.references import supporters_of, with_contradiction, without_agreement
from mapless_server.method.options import DoubtOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.scenes import ANYWHERE, Choice

from .query import TRYING, CutReason, LadderCut, Result, Tier, Tried
from .search import UNFINISHED, Search

_GEOMETRIC = GeometricReconstructor()


class Verdicts:
    """Makes results of what attempts with these tiers have found."""

    def __init__(self, tiers: Sequence[Tier], doubt: DoubtOptions) -> None:
        self._tiers = tiers
        self._doubt = doubt

    def tier(self, attempt: Attempt) -> Tier:
        """The features and backend of an attempt."""
        tier = self._tiers[attempt.features]
        return _that_triangulates(tier) if attempt.where is Where.NEAR_PRIOR else tier

    def doubt_in(self, search: Search) -> DoubtOptions:
        """Adapts the options to the scene's quantiles of trust, so that the same answers are doubtful in all scenes."""
        calibration = search.attributes.self_calibration(self._tiers[search.attempt.features].kind)
        if calibration is None:
            return self._doubt
        return replace(self._doubt, trust=trust_in_scene(self._doubt.trust, calibration.trust_quantiles))

    def pipeline(self, search: Search, tier: Tier) -> Pipeline:
        """The pipeline of a tier, with the trust of the search's scene."""
        calibration = search.attributes.self_calibration(tier.kind)
        return tier.pipeline.with_trust(calibration.trust_quantiles if calibration else ())

    def within_limits(self, search: Search, found: Found) -> Found:
        """The result, rejected if its pose is beyond hard limits, or its references contradict one another."""
        outcome, narrowing = found.answer.outcome, search.query.narrowing
        if not isinstance(outcome, Localization):
            return self._without_imprecise(search, found)
        if narrowing is not ANYWHERE:
            beyond = narrowing.contradiction(outcome.world_from_camera, search.attributes.unit)
            if beyond:
                rejection = Rejection(RejectionReason.PRIOR_CONFLICT, beyond)
                return _rejected(found, rejection, Doubt.BEYOND_LIMITS)
        if search.attributes.contradiction and isinstance(found.answer.support, PosedSupport):
            disagreement = without_agreement([supporters_of(found.answer.support)])
            if disagreement:
                return _rejected(found, disagreement, Doubt.CHANCE)
        return found

    def _without_imprecise(self, search: Search, found: Found) -> Found:
        """The rejection without its pose, if that is beyond hard limits, or the scene contradicts itself."""
        outcome = found.answer.outcome
        if not isinstance(outcome, Rejection) or outcome.imprecise is None:
            return found
        pose, unit = outcome.imprecise.world_from_camera, search.attributes.unit
        if not search.attributes.contradiction and not search.query.narrowing.contradiction(pose, unit):
            return found
        return replace(found, answer=replace(found.answer, outcome=replace(outcome, imprecise=None)))

    def answer(self, search: Search, compares: bool = True) -> Result:
        """The result for the caller by the verdict; see `hints.hinted` for `compares`."""
        verdict = search.verdict
        assert verdict is not None
        chosen = verdict.chosen
        search = search.in_scene(chosen.attempt.scene, self.tier(search.attempt).features)
        if search.query.is_part and chosen.answer.support is None:  # its group needs what matches there are
            chosen = next((it for it in reversed(search.found) if it.answer.support is not None), chosen)
        material = search.materials[search.found.index(chosen)]
        result = self.result(search, chosen, material, verdict.outcome, compares)
        ended = zip(search.attempts, search.tried, strict=True)
        attempts = tuple(replace(it, is_chosen=tried == chosen.attempt) for it, tried in ended)
        answer = _with_unfinished(result.answer, attempts, search.cuts)
        return replace(result, answer=answer, attempts=attempts, cuts=search.cuts, missing=search.missing)

    def without_present(self, search: Search, outcome: str, reason: CutReason) -> Result:
        """The result without the present attempt, which ended so; quickly, since the queue may wait for it."""
        features = self.tier(search.attempt).features
        return self.answer(search.ended(outcome, features).cut(search.rung, features, reason), compares=False)

    def result(
        self,
        search: Search,
        found: Found,
        material: Material,
        outcome: Localization | Rejection,
        compares: bool = True,
    ) -> Result:
        """The result of an attempt with an outcome, whose hint says what would help."""
        answer, contradiction = replace(found.answer, outcome=outcome), material.attributes.contradiction
        if isinstance(outcome, Rejection):
            has_prior = material.is_searched and not search.query.narrowing.is_empty
            answer = hinted(answer, material.view, material.references, has_prior, compares)
            assert isinstance(answer.outcome, Rejection)
            answer = replace(answer, outcome=with_contradiction(answer.outcome, contradiction))
        group = search.group
        return Result(
            answer,
            self.tier(found.attempt),
            material.references,
            material.scene,
            material.view.camera,
            material.choice,
            _other_choices(search, material),
            material.attributes,
            search.seconds(self.tier(search.attempt).features),
            camera=material.camera,
            scene_key=search.query.scene_key if group is None or material.is_searched else None,
            scenes=() if group is None else group.tried_scenes(search.tried),
            searched_scene_count=1 if group is None else group.searched_count,
        )


def _other_choices(search: Search, material: Material) -> tuple[Choice, ...]:
    """The choices of all attempts by other descriptors than that of the material's, one each, in order."""
    chosen = {it.choice.descriptor: it.choice for it in search.materials if it.choice is not None}
    return tuple(it for name, it in chosen.items() if material.choice is None or name != material.choice.descriptor)


def _with_unfinished(answer: Answer, attempts: Sequence[Tried], cuts: Sequence[LadderCut]) -> Answer:
    """Says in the hint of a rejection which attempt was not finished: repeating the call may then succeed."""
    lacking = [it.rung for it in cuts if it.reason is CutReason.FEATURES_MISSING]
    rejection, rungs = answer.outcome, lacking or [it.rung for it in attempts if it.outcome in UNFINISHED]
    if not isinstance(rejection, Rejection) or rejection.hint is None or not rungs:
        return answer
    untried = next((it.untried for it in ladder.RUNGS if it.name == rungs[0]), "as it is")
    advice = "asking again, when less is asked, may help."
    if lacking:
        advice = "the scene's references still lack evidence, made in the background; asking again later may help."
    advice = f"{TRYING} {untried} was not finished: {advice}"
    hint = replace(rejection.hint, message=f"{rejection.hint.message} {advice}")
    return replace(answer, outcome=replace(rejection, hint=hint))


def _rejected(found: Found, rejection: Rejection, doubts: Doubt) -> Found:
    return replace(found, answer=replace(found.answer, outcome=rejection), doubts=doubts)


def _that_triangulates(tier: Tier) -> Tier:
    return replace(tier, pipeline=replace(tier.pipeline, reconstructor=_GEOMETRIC))
