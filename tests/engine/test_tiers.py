"""When stronger features are tried, and which of two answers is the better one: a rule, case by case."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless_server import errors
from mapless_server.engine.failures import failure_of
from mapless_server.engine.options import EscalationOptions
from mapless_server.engine.query import Result, Tier
from mapless_server.engine.tiers import (
    SAME_POSITION_M,
    SAME_SHARE,
    UNRECOVERABLE,
    better_of,
    is_doubtful,
    of_two_places,
    place_of_priors,
)
from mapless_server.method.bundle.estimate import PoseEstimate, PoseStage, Support, TwoViewSupport
from mapless_server.method.bundle.priors import PositionPrior, Priors
from mapless_server.method.bundle.radii import accuracy_from_covariance, error_radii
from mapless_server.method.features.tracks import Tracks
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import (
    Advice,
    Hint,
    Hypothesis,
    IntrinsicsCheck,
    IntrinsicsParameter,
    Rejection,
    RejectionReason,
)
from mapless_server.method.structure.model import PointMatches, Structure
from mapless_server.method.structure.observations import KeypointNoise
from mapless_server.scheduling import Failure
from mapless_server.store import SceneAttributes

OPTIONS = EscalationOptions()
CAMERA = Camera(96, 64, 80.0, 81.0, 47.5, 31.5)


class Named:
    """An extractor that is only asked for its name."""

    def __init__(self, name: str) -> None:
        self.name = name

    def extract(self, *_: Any) -> Any:
        raise NotImplementedError


CHEAP, STRONG = (Tier(Named(name), Pipeline()) for name in ("cheap", "strong"))


def localized(
    x_m: float = 0.0, sigma_m: float = 0.01, inliers: int = 100, turn_deg: float = 0.0, trust: float = 0.5
) -> Answer:
    """A pose at x with equal errors along all axes, and of so many degrees a metre of error."""
    pose = RigidTransform(rotation_from_vector([0.0, np.radians(turn_deg), 0.0]), np.array([x_m, 0.0, 0.0]))
    covariance = np.diag([sigma_m**2] * 3 + [np.radians(0.1) ** 2] * 3)
    return Answer(Localization(pose, covariance, PoseStage.REFINED, inliers, 2 * inliers, 0.7, (), trust))


DISTANCE_M = 10.0


def found(answer: Answer, x_m: float, inliers: int, sigma_m: float = 0.01) -> Answer:
    """With the pose that was found, whether accepted or not, of points 10 m ahead."""
    points, none = np.tile([x_m, 0.0, DISTANCE_M], (inliers, 1)), np.empty(0, np.intp)
    matches = PointMatches(np.arange(inliers), np.arange(inliers), np.zeros(inliers, bool), 20.0)
    pose = RigidTransform(np.eye(3), np.array([x_m, 0.0, 0.0]))
    estimate = PoseEstimate(pose, PoseStage.REFINED, np.ones(inliers, bool), np.zeros(inliers), sigma_m**2 * np.eye(6))
    structure = Structure(points, Tracks(none, none, none), KeypointNoise(1.0, 0.0))
    unused: Any = None
    return replace(answer, support=Support(unused, (), structure, matches, estimate, np.zeros(3)))


def rejected(reason: RejectionReason = RejectionReason.TOO_FEW_MATCHES) -> Answer:
    return Answer(Rejection(reason, "planted"))


def better(cheap: Answer, strong: Answer) -> Result:
    return better_of(Result(cheap, CHEAP, (), 1, CAMERA), Result(strong, STRONG, (), 1, CAMERA))


class TestDoubt:
    @pytest.mark.parametrize("reason", RejectionReason)
    def test_a_rejection_is_doubtful_unless_references_caused_it(self, reason: RejectionReason) -> None:
        assert is_doubtful(rejected(reason), OPTIONS) is (reason not in UNRECOVERABLE)
        assert {it.name for it in UNRECOVERABLE} == {"NO_USABLE_REFERENCES", "DEGENERATE_REFERENCES"}

    def test_a_wrong_focal_length_is_not_doubtful(self) -> None:
        check = IntrinsicsCheck(IntrinsicsParameter.FOCAL_LENGTH, 525.0, 541.0, 2.0, 1.6, conflict=True, used=True)
        rejection = Rejection(RejectionReason.GATE, "planted", intrinsics_checks=(check,))
        assert not is_doubtful(Answer(rejection), OPTIONS)

    @given(trust=st.floats(0, 1), sigma_m=st.floats(1e-4, 1.0))
    def test_low_trust_or_a_large_radius_is_doubtful(self, trust: float, sigma_m: float) -> None:
        radius_m = float(error_radii(np.eye(3) * sigma_m**2, [0.68])[0])
        expected = trust < OPTIONS.doubtful_trust or radius_m > OPTIONS.doubtful_radius_m
        assert is_doubtful(localized(sigma_m=sigma_m, trust=trust), OPTIONS) is expected

    def test_a_coarse_pose_is_not_doubtful(self) -> None:
        coarse = Localization(RigidTransform.identity(), None, PoseStage.INITIAL, 0, 0, 0.0)
        assert not is_doubtful(Answer(coarse), OPTIONS)


class TestBetter:
    def test_a_localization_is_better_than_a_rejection(self) -> None:
        assert better(rejected(), localized()).tier is STRONG
        assert better(localized(), rejected()).tier is CHEAP

    def test_of_two_rejections_the_stronger_tiers_is_answered(self) -> None:
        answer = better(rejected(RejectionReason.LOW_TEXTURE), rejected(RejectionReason.LOW_OVERLAP))
        assert answer.tier is STRONG
        assert isinstance(answer.answer.outcome, Rejection)
        assert answer.answer.outcome.reason is RejectionReason.LOW_OVERLAP

    def test_radii_of_disagreeing_halves_join_no_two_places(self) -> None:
        """Two poses 1 m apart contradict each other, though 0.5 m is claimed, as the jackknife knows them to 1 cm."""
        first, second = (found(localized(x_m, 0.5, 100), x_m, 100, sigma_m=0.01) for x_m in (0.0, 1.0))
        assert isinstance(better(first, second).answer.outcome, Rejection)
        assert isinstance(better(localized(0.0, 0.5), localized(1.0, 0.5)).answer.outcome, Localization)

    @pytest.mark.parametrize(
        ("sigmas", "tier"), [((0.02, 0.01), STRONG), ((0.01, 0.02), CHEAP), ((0.02, 0.02), STRONG)]
    )
    def test_of_two_that_agree_the_smaller_claim_is_better(self, sigmas: tuple[float, float], tier: Tier) -> None:
        first, second = (localized(0.01 * i, sigma, inliers=30) for i, sigma in enumerate(sigmas))
        assert better(first, second).tier is tier

    @pytest.mark.parametrize(("inliers", "tier"), [(30, None), (44, None), (45, STRONG), (300, STRONG)])
    @pytest.mark.parametrize("far", [{"x_m": 3.0}, {"turn_deg": 20.0}], ids=["far", "turned"])
    def test_of_two_contradictory_poses_the_clearly_better_is_taken(
        self, far: dict[str, float], inliers: int, tier: Tier | None
    ) -> None:
        chosen = better(localized(inliers=30), localized(inliers=inliers, **far))
        assert chosen.tier is STRONG, "the doubtful pose of the cheap features is contradicted either way"
        outcome = chosen.answer.outcome
        if tier is None:
            assert isinstance(outcome, Rejection)
            assert outcome.reason is RejectionReason.GATE
            apart = "3.00 m and 0.0 degrees" if "x_m" in far else "0.00 m and 20.0 degrees"
            expected = f"the pose of cheap (30 inliers) and that of strong ({inliers}) are {apart} apart"
            assert outcome.message == f"the features disagree: {expected}"
        else:
            assert isinstance(outcome, Localization)

    def test_a_photograph_that_fits_two_places_turned_says_so(self) -> None:
        as_it_is, turned = found(rejected(RejectionReason.GATE), 0.0, 30), found(localized(3.0, inliers=40), 3.0, 40)
        for scene, unit in ((SceneAttributes(), "m"), (SceneAttributes(arbitrary_unit=True), "units")):
            results = [Result(it, CHEAP, (), 1, CAMERA, attributes=scene) for it in (as_it_is, turned)]
            outcome = better_of(results[0], results[1]).answer.outcome
            assert isinstance(outcome, Rejection)
            assert outcome.message.startswith("the photograph fits two places: the pose as it is (30 inliers)")
            assert f" are 3.00 {unit} and " in outcome.message

    @pytest.mark.parametrize("reason", [RejectionReason.GATE, RejectionReason.AMBIGUOUS])
    @pytest.mark.parametrize(("inliers", "is_answered"), [(44, False), (45, True)])
    def test_a_rejected_pose_elsewhere_contradicts_unless_weaker(
        self, reason: RejectionReason, inliers: int, is_answered: bool
    ) -> None:
        for share, expected in ((0.9, True), (1.1, is_answered)):
            x_m = share * SAME_SHARE * DISTANCE_M
            first = found(rejected(reason), 0.0, 30)
            second = found(localized(x_m, inliers=inliers), x_m, inliers)
            chosen = better(first, second)
            assert chosen.tier is STRONG
            assert isinstance(chosen.answer.outcome, Localization) is expected

    @pytest.mark.parametrize(("sigma_m", "is_answered"), [(0.1, False), (1.0, True)])
    def test_a_rejected_pose_contradicts_beyond_its_radius(self, sigma_m: float, is_answered: bool) -> None:
        first = found(rejected(RejectionReason.GATE), 0.0, 100, sigma_m)
        second = found(localized(1.0, inliers=100), 1.0, 100)
        assert isinstance(better(first, second).answer.outcome, Localization) is is_answered

    def test_a_rejected_pose_has_the_inliers_of_two_views_too(self) -> None:
        first, second = found(rejected(RejectionReason.AMBIGUOUS), 0.0, 10), found(localized(3.0, inliers=60), 3.0, 60)
        assert isinstance(better(first, second).answer.outcome, Localization)
        assert first.support is not None
        many = np.zeros(50, np.intp)
        two_view = TwoViewSupport(many, many, many, np.zeros(50), np.ones(50, bool), np.tile([0.0, 0, 9], (50, 1)))
        first = replace(first, support=replace(first.support, two_view=two_view))
        assert isinstance(better(first, second).answer.outcome, Rejection)

    def test_a_pose_that_contradicted_a_prior_is_no_evidence(self) -> None:
        first = found(rejected(RejectionReason.PRIOR_CONFLICT), 0.0, 300)
        assert isinstance(better(first, found(localized(3.0), 3.0, 100)).answer.outcome, Localization)

    @given(apart_m=st.floats(0, 3), sigma_m=st.floats(1e-3, 0.5))
    def test_poses_agree_within_the_sum_of_95_radii_or_the_distance(self, apart_m: float, sigma_m: float) -> None:
        chosen = better(localized(0.0, sigma_m, inliers=40), localized(apart_m, 0.01, inliers=40))
        reach_m = sum(accuracy_from_covariance(np.eye(6) * it**2).position_95_m for it in (sigma_m, 0.01))
        if abs(apart_m - max(reach_m, SAME_POSITION_M)) > 1e-9:
            agree = apart_m < max(reach_m, SAME_POSITION_M)
            assert isinstance(chosen.answer.outcome, Localization if agree else Rejection)


class TestTwoPlaces:
    """Poses where a soft prior says the camera is, and 30 m away."""

    @pytest.mark.parametrize(
        ("there", "elsewhere", "chosen"),
        [
            (rejected(), found(localized(30.0), 30.0, 100), "elsewhere"),
            (found(localized(), 0.0, 100), rejected(), "there"),
            (found(localized(inliers=100), 0.0, 100), found(localized(30.0, inliers=149), 30.0, 149), "there"),
            (found(localized(inliers=90), 0.0, 90), found(localized(0.05, inliers=200), 0.05, 200), "there"),
            (found(rejected(RejectionReason.GATE), 0.0, 80), found(localized(30.0), 30.0, 100), "there"),
            (found(rejected(RejectionReason.GATE), 0.0, 60), found(localized(30.0), 30.0, 100), "elsewhere"),
            (found(rejected(RejectionReason.GATE), 29.9, 80), found(localized(30.0), 30.0, 100), "elsewhere"),
            (found(rejected(), 0.0, 10), found(rejected(), 30.0, 9), "there"),
            (found(rejected(), 0.0, 10), found(rejected(), 30.0, 11), "elsewhere"),
            (rejected(), rejected(), "there"),
        ],
    )
    def test_prior_decides_unless_more_is_seen_elsewhere(self, there: Answer, elsewhere: Answer, chosen: str) -> None:
        results = {"there": Result(there, CHEAP, (), 1, CAMERA), "elsewhere": Result(elsewhere, CHEAP, (), 1, CAMERA)}
        assert of_two_places(results["there"], results["elsewhere"]) is results[chosen]

    @pytest.mark.parametrize(("x_m", "turn_deg"), [(30.0, 0.0), (0.0, 180.0)])
    def test_two_poses_are_ambiguous_if_more_is_seen_elsewhere(self, x_m: float, turn_deg: float) -> None:
        there = found(localized(), 0.0, 100)
        elsewhere = found(localized(x_m, inliers=150, turn_deg=turn_deg), x_m, 150)
        results = [Result(it, CHEAP, (), 1, CAMERA) for it in (there, elsewhere)]
        outcome = of_two_places(results[0], results[1]).answer.outcome
        assert isinstance(outcome, Rejection)
        assert outcome.reason is RejectionReason.AMBIGUOUS
        assert [it.inlier_count for it in outcome.hypotheses] == [150, 100]

    @pytest.mark.parametrize(("inliers", "decides"), [(101, True), (100, False)])
    def test_priors_do_not_decide_against_clearly_more_inliers(self, inliers: int, decides: bool) -> None:
        here, there = (RigidTransform(np.eye(3), np.array([x_m, 0.0, 0.0])) for x_m in (0.0, 6.0))
        hypotheses = Hypothesis(there, 150, ("there",)), Hypothesis(here, inliers, ("here",))
        outcome = Rejection(RejectionReason.AMBIGUOUS, "planted", hypotheses=hypotheses)
        place = place_of_priors(outcome, Priors(position=PositionPrior(np.zeros(3), 0.05**2 * np.eye(3))))
        if decides:
            assert place is hypotheses[1]
        else:
            assert isinstance(place, Hint)
            assert (place.advice, "the other place" in place.message) == (Advice.CHECK_PRIOR, True)


LOST = [
    "CUDA error: an illegal memory access was encountered\nCUDA kernel errors might be asynchronously reported",
    "CUDA error: device-side assert triggered",
    "CUDA error: unspecified launch failure",
    "CUDA error: uncorrectable ECC error encountered",
    "CUDA error: CUBLAS_STATUS_EXECUTION_FAILED when calling `cublasSgemm( handle, opa, opb, m, n, k)`",
    "CUDA error: CUBLAS_STATUS_INTERNAL_ERROR when calling `cublasCreate(handle)`",
    "cuDNN error: CUDNN_STATUS_EXECUTION_FAILED",
]
FULL = [
    "CUDA out of memory. Tried to allocate 20.00 MiB. GPU 0 has a total capacity of 139.81 GiB",
    "CUDA error: out of memory",
    "CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`",
    "cuDNN error: CUDNN_STATUS_ALLOC_FAILED",
]
HARMLESS = [
    "mat1 and mat2 shapes cannot be multiplied (3x4 and 5x6)",
    "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu!",
    "",
]


def caught(raises: Callable[[], object]) -> BaseException:
    with pytest.raises(BaseException) as info:  # noqa: PT011  whatever it is
        raises()
    return info.value


@pytest.mark.parametrize("message", LOST)
def test_a_poisoned_context_is_the_end_of_the_device(message: str) -> None:
    assert failure_of(RuntimeError(message)) is Failure.DEVICE_LOST


@pytest.mark.parametrize("message", FULL)
def test_a_full_device_is_not(message: str) -> None:
    """The same words, "CUDA error", and after it everything works again."""
    assert failure_of(RuntimeError(message)) is Failure.OUT_OF_MEMORY


@pytest.mark.parametrize("message", HARMLESS)
def test_a_fault_in_our_own_arithmetic_is_of_the_item(message: str) -> None:
    assert failure_of(RuntimeError(message)) is Failure.JOB_FAILED


@pytest.mark.parametrize("message", [*LOST, *FULL])
def test_the_text_alone_does_nothing_in_another_exception_type(message: str) -> None:
    """A caller may send a scene of that name."""
    assert failure_of(ValueError(message)) is Failure.JOB_FAILED
    assert failure_of(errors.InvalidArgument(message)) is Failure.BAD_INPUT


@pytest.mark.parametrize(
    "kind", [it for it in vars(errors).values() if isinstance(it, type) and issubclass(it, errors.RequestError)]
)
def test_only_errors_the_caller_can_fix_are_of_the_request(kind: type[errors.RequestError]) -> None:
    """Damaged bytes in the store, or a scene that is being emptied, are reported to the caller, and not its fault."""
    of_server = kind.__name__ in ("RequestError", "Overloaded", "DeadlineExceeded", "Unavailable", "DataLoss")
    assert failure_of(kind("text")) is (Failure.JOB_FAILED if of_server else Failure.BAD_INPUT)


def test_memory_of_the_host() -> None:
    assert failure_of(MemoryError()) is Failure.OUT_OF_MEMORY
    assert failure_of(caught(lambda: np.zeros(2**56, np.uint8))) is Failure.OUT_OF_MEMORY  # a kind of its own


def test_an_earlier_handled_failure_does_not_affect_this_one() -> None:
    def handle() -> None:
        try:
            raise RuntimeError(LOST[0])
        except RuntimeError as lost:
            raise errors.InvalidArgument("another matter") from lost

    assert failure_of(caught(handle)) is Failure.BAD_INPUT


class TestTorch:
    """With the classes that torch raises."""

    def test_out_of_memory(self) -> None:
        torch = pytest.importorskip("torch", reason="the networks' extra is not installed")
        assert failure_of(torch.OutOfMemoryError("CUDA out of memory. Tried to allocate")) is Failure.OUT_OF_MEMORY
        assert failure_of(torch.cuda.OutOfMemoryError("whatever it says")) is Failure.OUT_OF_MEMORY

    def test_an_accelerator_error(self) -> None:
        torch = pytest.importorskip("torch", reason="the networks' extra is not installed")
        if not hasattr(torch, "AcceleratorError"):
            pytest.skip("torch is too old")
        assert failure_of(torch.AcceleratorError(LOST[0])) is Failure.DEVICE_LOST
        assert failure_of(torch.AcceleratorError("a text of a later version")) is Failure.DEVICE_LOST
        assert failure_of(torch.AcceleratorError("CUDA error: out of memory")) is Failure.OUT_OF_MEMORY

    def test_memory_of_the_host(self) -> None:
        """Torch says it with a RuntimeError of its own words."""
        torch = pytest.importorskip("torch", reason="the networks' extra is not installed")
        assert failure_of(caught(lambda: torch.empty(2**60))) is Failure.OUT_OF_MEMORY
