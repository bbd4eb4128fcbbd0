"""Self-calibration on scenes with a planted truth: what references say of answers, and what wrong ones must not say."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtri
from support.scenes import SceneOptions, make_scene, random_for
from support.servers import StandInDescriptor, StandInExtractor
from support.stores import Folder, Place, let_pass

import mapless
from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.errors import Unavailable
from mapless_server.method.bundle.estimate import SELF_TAIL_95, TAIL_95, USUAL_GAP, Accuracy, growth
from mapless_server.method.bundle.intrinsics import corrected_view
from mapless_server.method.features.views import PosedView
from mapless_server.method.judge.judge import LEVELS, trust_in_scene
from mapless_server.method.pipeline import Pipeline
from mapless_server.scenes.calibration.calibrator import FIRST_SAMPLE, MAX_CPU_S, Calibrator, SceneCalibrations
from mapless_server.scenes.calibration.fit import FitOptions, LeftOut, fit
from mapless_server.scenes.calibration.lens import SharedErrors, lens_contradiction, without_errors
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import Closed, ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, SelfCalibration, Store, adoption, calibration_kind

SCENE = SceneKey("s")
EXTRACTOR, DESCRIPTOR = StandInExtractor(), StandInDescriptor()
KIND = calibration_kind(EXTRACTOR.name, "geometric", "1")
REFERENCES = make_scene(
    random_for("calibration"), SceneOptions(point_count=200, reference_count=7, baseline_m=0.3)
).references
Change = Callable[[RigidTransform], RigidTransform]


def result(ratio: float, gap: float = USUAL_GAP, trust: float = 0.5, radius_m: float = 0.01) -> LeftOut:
    """Errors that are so many times the radii of 68 %, whose double are those of 95 %."""
    claimed, grown = Accuracy(radius_m, 2 * radius_m, 0.1, 0.2), ratio * growth(gap)
    return LeftOut(radius_m * grown, 0.1 * grown, claimed, trust, gap, 50.0)


def spread(count: int, factor: float, gap: float = USUAL_GAP) -> list[LeftOut]:
    """Results with a planted factor, as the model has them."""
    options = FitOptions()
    normal = ndtri((np.arange(count) + 0.5) / count)
    return [result(factor * it, gap) for it in options.median_ratio * np.exp(options.scatter * normal)]


class TestFit:
    def test_many_answers_give_the_planted_factor(self) -> None:
        found = fit(spread(2000, 2.5), KIND, 7, FitOptions(noise_share=0.01))
        assert (found.kind, found.generation, found.answer_count) == (KIND, 7, 2000)
        assert found.position_factor == pytest.approx(2.5, rel=0.05)
        assert found.rotation_factor == pytest.approx(2.5, rel=0.05)

    @pytest.mark.parametrize("factor", [0.4, 2.5])
    @pytest.mark.parametrize("count", [3, 6, 20])
    def test_few_answers_count_as_stated(self, factor: float, count: int) -> None:
        options = FitOptions(noise_share=0.01)
        found = fit(spread(count, factor), KIND, 1, options)
        n0 = (options.scatter / options.factor_log) ** 2
        assert np.log(found.position_factor) == pytest.approx(count / (count + n0) * np.log(factor), abs=0.05)

    def test_few_answers_leave_wider_radii(self) -> None:
        tails = [fit(spread(count, 1.0), KIND, 7).position_tail for count in (3, 10, 100, 3000)]
        assert tails == sorted(tails, reverse=True)
        assert tails[-1] == pytest.approx(SELF_TAIL_95 / TAIL_95, rel=0.02)

    def test_a_larger_gap_explains_larger_errors(self) -> None:
        near, far = (fit(spread(30, 2.0, gap), KIND, 1, FitOptions(noise_share=0.01)) for gap in (0.05, 0.4))
        assert near.position_factor == pytest.approx(far.position_factor, rel=0.03)

    def test_errors_that_do_not_shrink_are_of_the_references(self) -> None:
        """The radii of some answers are a tenth of those of others, their errors are not."""
        options, random = FitOptions(noise_share=1.0), random_for("noise")
        radii_m = np.geomspace(0.002, 0.02, 300)
        errors_m = np.hypot(radii_m, 0.01) * options.median_ratio * np.exp(options.scatter * random.normal(size=300))
        planted = [result(e / r, radius_m=r) for e, r in zip(errors_m, radii_m, strict=True)]
        found = fit(planted, KIND, 1, options)
        assert found.reference_noise_m == pytest.approx(0.01, rel=0.25)
        assert found.position_factor == pytest.approx(1.0, rel=0.25)

    def test_one_wrong_answer_changes_nothing(self) -> None:
        right = spread(20, 1.5)
        wrong = replace(result(1.0), error_m=4.0)
        found = fit([*right, wrong], KIND, 1)
        assert replace(found, trust_quantiles=()) == replace(fit(right, KIND, 1), trust_quantiles=())

    def test_two_answers_say_nothing(self) -> None:
        assert fit(spread(2, 9.0), KIND, 3) == SelfCalibration(KIND, 3, 0)

    def test_hard_scenes_lower_what_trust_is_usual(self) -> None:
        hard = fit([replace(it, trust=0.02) for it in spread(40, 1.0)], KIND, 1)
        quantiles = np.array(hard.trust_quantiles)
        assert (quantiles <= LEVELS).all()
        assert (np.diff(quantiles) >= 0).all()
        assert trust_in_scene(0.02, hard.trust_quantiles) > 0.5
        easy = fit([replace(it, trust=0.9) for it in spread(40, 1.0)], KIND, 1)
        assert easy.trust_quantiles == pytest.approx(LEVELS)  # not stricter

    def test_own_wrong_answers_stay_rejected(self) -> None:
        hard = [replace(it, trust=0.03) for it in spread(40, 1.0)]
        wrong = replace(result(1.0), error_m=4.0, trust=0.04)
        assert trust_in_scene(0.04, fit(hard, KIND, 1).trust_quantiles) > 0.05
        assert trust_in_scene(0.0399, fit([*hard, wrong], KIND, 1).trust_quantiles) < 0.05


@dataclass
class Counts(BackgroundObserver):
    """The notifications of an observer."""

    calibrated: int = 0
    failures: int = 0
    waits: int | None = None

    def count(self, name: str, amount: float = 1.0, result: str = "") -> None:
        assert amount >= 0
        self.calibrated += name == "calibrations"
        self.failures += name == "calibration_failures"

    def waiting(self, name: str, count: int) -> None:
        self.waits = count


class Server:
    """One server's part of calibrating, without its queue."""

    def __init__(self, store: Store, max_cpu_s: float = MAX_CPU_S) -> None:
        self.store, self.counts = store, Counts()
        indexes = SceneIndexes(store, ReferenceLibrary(store), DESCRIPTOR, EXTRACTOR, 2**30)
        self.calibrator = Calibrator(indexes, EXTRACTOR, Pipeline(), KIND, max_cpu_s)
        self.calibrations = SceneCalibrations(store, self.calibrator, self.counts)

    def run(self, pause: Callable[[], None] = lambda: None) -> SelfCalibration | None:
        while self.calibrations.calibrate_next(pause):
            pass
        return self.store.get_attributes(SCENE).self_calibration(KIND)


@pytest.fixture
def place(tmp_path: Path) -> Folder:
    return Folder(tmp_path / "data")


@pytest.fixture
def store(place: Folder) -> Iterator[Store]:
    with place.open() as store:
        store.create_scene(SCENE)
        yield store


def add(store: Store, references: Sequence[PosedView], change: Change = lambda it: it) -> None:
    store.add_references(SCENE, new_references(references, change))


def new_references(references: Sequence[PosedView], change: Change = lambda it: it) -> list[NewReference]:
    vector = np.zeros(16, np.float32)
    new = []
    for i, it in enumerate(references):
        vector[:2] = np.cos(i / 5), np.sin(i / 5)
        described = {EXTRACTOR.name: it.view}, {DESCRIPTOR.name: vector.copy()}
        new.append(NewReference(f"r{i}", b"%d" % i, it.view.camera, change(it.world_from_camera), *described))
    return new


def similar(scale: float) -> Change:
    turn = rotation_from_vector([0.3, -1.0, 0.2])
    return lambda it: RigidTransform(turn @ it.rotation, scale * turn @ it.translation + [100.0, -40.0, 7.0])


def mirrored(it: RigidTransform) -> RigidTransform:
    """In a world whose z has the other sign, with rotations of the right hand all the same."""
    mirror = np.diag([1.0, 1.0, -1.0])
    return RigidTransform(mirror @ it.rotation @ mirror, mirror @ it.translation)


def with_errors(references: Sequence[PosedView], errors: Sequence[float]) -> list[PosedView]:
    """The same photographs with intrinsics that are off by these errors of `bundle.intrinsics`, stored as pinholes."""
    wrong = [corrected_view(it.view, np.array(errors)) for it in references]
    return [replace(it, view=replace(view, distortion=None)) for it, view in zip(references, wrong, strict=True)]


def found_in(store: Store, references: Sequence[PosedView], change: Change = lambda it: it) -> SelfCalibration:
    add(store, references, change)
    found = Server(store).run()
    assert found is not None
    return found


class TestLens:
    def test_without_errors_keypoints_are_the_planted_ones(self) -> None:
        wrong = with_errors(REFERENCES[:1], [0.0, 0.0, 0.0, 0.01])[0]
        right = without_errors(wrong, SharedErrors(np.array([0.0, -0.01]), np.zeros(2)))
        planted = REFERENCES[0].view.features.keypoints
        assert np.abs(wrong.view.features.keypoints - planted).max() > 1
        assert np.abs(right.view.features.keypoints - planted).max() < 0.1

    def test_errors_that_disagree_are_not_certain(self) -> None:
        own = [SharedErrors(np.array([0.0, it]), np.full(2, 0.001)) for it in (-0.2, 0.0, 0.1, 0.3)]
        assert lens_contradiction(own) is None
        alike = [SharedErrors(np.array([0.0, it]), np.full(2, 0.001)) for it in (0.09, 0.1, 0.1, 0.11)]
        found = lens_contradiction(alike)
        assert found is not None
        assert found.value.tolist() == [0.0, pytest.approx(0.1)]
        assert lens_contradiction(alike[:3]) is None


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> SelfCalibration:
    """The calibration of the references as they are."""
    with Folder(tmp_path_factory.mktemp("usual")).open() as store:
        store.create_scene(SCENE)
        return found_in(store, REFERENCES)


class TestScenes:
    def test_references_are_localized_against_the_others(self, usual: SelfCalibration) -> None:
        assert (usual.answer_count, usual.lens) == (len(REFERENCES), "")
        assert 0.3 < usual.position_factor < 3
        assert 0.3 < usual.rotation_factor < 3

    def test_a_lens_left_out_is_named(self, store: Store) -> None:
        found = found_in(store, with_errors(REFERENCES, [0.0, 0.0, 0.0, 0.3]))
        assert found.lens.startswith("matches between the references show another lens distortion (k1 -0.2")
        assert found.answer_count == len(REFERENCES)

    @pytest.mark.nightly
    def test_a_wrong_focal_length_of_all_is_named(self, store: Store) -> None:
        found = found_in(store, with_errors(REFERENCES, [0.1, 0.0, 0.0, 0.0]))
        assert "another focal length (-" in found.lens
        assert "distortion" not in found.lens

    def test_all_wrong_by_a_similarity_say_the_same(self, store: Store, usual: SelfCalibration) -> None:
        found = found_in(store, REFERENCES, similar(1000.0))  # in millimetres
        assert found.answer_count == usual.answer_count
        assert found.position_factor == pytest.approx(usual.position_factor, rel=0.1)
        assert found.rotation_factor == pytest.approx(usual.rotation_factor, rel=0.1)

    @pytest.mark.nightly
    def test_mirrored_ones_say_nothing(self, store: Store) -> None:
        assert found_in(store, REFERENCES[:5], mirrored).answer_count == 0

    def test_those_of_one_place_say_nothing(self, store: Store) -> None:
        here = REFERENCES[0].world_from_camera.translation
        found = found_in(store, REFERENCES, lambda it: RigidTransform(it.rotation, here))
        assert replace(found, generation=0) == SelfCalibration(KIND, 0, 0)

    @pytest.mark.parametrize("count", [0, 1, 2])
    def test_too_few_say_nothing(self, store: Store, count: int) -> None:
        if count:
            add(store, REFERENCES[:count])
            assert Server(store).run() == SelfCalibration(KIND, store.get_generation(SCENE), 0)
        else:
            assert Server(store).run() is None

    def test_a_wrong_pose_among_good_ones_spoils_nothing(self, store: Store, usual: SelfCalibration) -> None:
        wrong = replace(REFERENCES[3], world_from_camera=REFERENCES[3].world_from_camera.shifted([0.0, 0.0, 2.0]))
        found = found_in(store, [*REFERENCES[:3], wrong, *REFERENCES[4:]])
        assert found.answer_count in (len(REFERENCES) - 1, len(REFERENCES) - 2)
        for name in ("position_factor", "rotation_factor"):
            assert getattr(found, name) == pytest.approx(getattr(usual, name), rel=0.5)

    def test_a_copy_does_not_answer_for_itself(self, store: Store) -> None:
        add(store, [REFERENCES[0]] * 2)
        store.update_scene(SCENE, down_in_world=None)
        found = Server(store).run()
        assert found is not None
        assert found.answer_count == 0

    def test_adopted_ones_neither_answer_nor_vouch(self, store: Store, usual: SelfCalibration) -> None:
        """The last one, adopted, changes nothing, although it was localized from the others."""
        add(store, REFERENCES[:-1])
        surveyed = Server(store).run()
        assert surveyed is not None
        store.update_scene(SCENE, adoption=mapless.AdoptionPolicy())
        *_, last = new_references(REFERENCES)
        radii = mapless.Accuracy(0.01, 0.02, 0.1, 0.2)
        provenance = mapless.Provenance("ADOPTED", radii, 0.5, (mapless.Voucher("r0", 40),))
        keys = store.find_keys(SCENE, ["r0"])
        new = replace(last, provenance=provenance, place_key=keys["r0"], usefulness=0.2)
        adoption.adopt(store, SCENE, new, keys.values(), 4)
        found = Server(store).run()
        assert found is not None
        assert found == replace(surveyed, generation=found.generation)
        assert found.answer_count < usual.answer_count

    def test_adopted_ones_alone_say_nothing(self, store: Store) -> None:
        add(store, REFERENCES)
        adopted, calibrator = [f"r{i}" for i in range(len(REFERENCES))], Server(store).calibrator
        found = calibrator.calibrate(SCENE, ReferenceLibrary(store), [], lambda: None, adopted=adopted)
        assert found.answer_count == 0

    def test_the_time_is_bounded(self, store: Store) -> None:
        add(store, REFERENCES)
        found = Server(store, max_cpu_s=1e-9).run()
        assert found is not None
        assert found.answer_count == 0


class TestServers:
    def test_calibrate_each_change_once(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        add(store, REFERENCES[:4])
        first, second = Server(store), Server(store)
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(lambda it: it.run(), (first, second)))
        assert first.counts.calibrated + second.counts.calibrated == 1
        let_pass(monkeypatch, 1e6)
        first.run()
        assert first.counts.calibrated + second.counts.calibrated == 1
        store.delete_reference(SCENE, "r0")
        found = first.run()
        assert first.counts.calibrated + second.counts.calibrated == 2
        assert found is not None
        assert found.generation == store.get_generation(SCENE)
        assert first.counts.waits == 0

    def test_calibrate_first_from_few_references(self, store: Store) -> None:
        add(store, REFERENCES)
        server = Server(store)
        assert server.calibrations.calibrate_next(lambda: None, is_first=True)
        few = store.get_attributes(SCENE).self_calibration(KIND)
        assert few is not None
        assert 3 <= few.answer_count <= FIRST_SAMPLE
        assert not server.calibrations.calibrate_next(lambda: None, is_first=True)
        all_of_them = server.run()
        assert all_of_them is not None
        assert (server.counts.calibrated, all_of_them.generation) == (2, few.generation)

    def test_that_are_closed_leave_the_scene_to_others(self, store: Store) -> None:
        add(store, REFERENCES[:4])
        steps = iter(range(5))

        def close() -> None:
            if next(steps, None) is None:
                raise Closed

        with pytest.raises(Closed):
            Server(store).run(close)
        assert store.get_attributes(SCENE).self_calibrations == ()
        assert Server(store).run() is not None

    def test_that_lost_their_scene_store_nothing(self, store: Store) -> None:
        add(store, REFERENCES[:4])
        once = threading.Event()

        def delete() -> None:
            if not once.is_set():
                once.set()
                store.delete_scene(SCENE)
                store.create_scene(SCENE)

        server = Server(store)
        server.run(delete)
        assert (server.counts.calibrated, server.counts.failures) == (0, 0)
        assert store.get_attributes(SCENE).self_calibrations == ()

    def test_that_fail_try_again_later(self, store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
        add(store, REFERENCES[:4])
        server = Server(store)

        def fail(*_: object) -> None:
            raise Unavailable("the device is lost")

        with monkeypatch.context() as patch:
            patch.setattr(server.calibrator, "calibrate", fail)
            server.run()
        assert (server.counts.failures, server.counts.calibrated, server.counts.waits) == (1, 0, 1)
        server.run()
        assert server.counts.calibrated == 0  # not before 30 s
        let_pass(monkeypatch, 31)
        server.run()
        assert server.counts.calibrated == 1

    def test_ignore_damaged_references(self, store: Store, place: Place) -> None:
        add(store, REFERENCES)
        (key,) = store.find_keys(SCENE, ["r2"]).values()
        place.execute("UPDATE features SET sha256 = ? WHERE reference_key = ?", "0" * 64, key)
        found = Server(store).run()
        assert found is not None
        assert found.answer_count == len(REFERENCES) - 1
