"""A photograph whose raster is turned against the references, with features that match only what is upright."""

import asyncio
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.compare import pose_error
from support.corner import CAMERA, photograph, pose
from support.images import encode, textured, with_exif_orientation

from mapless.geometry import Camera, RigidTransform
from mapless_server.engine import choosing
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.photo_views import QueryViews
from mapless_server.engine.query import MIRROR, Caller, Photo, Query, Result, Tier
from mapless_server.engine.search import Search
from mapless_server.images import ImageLimits, decode_image, upright_of
from mapless_server.method.bundle.estimate import PosedSupport
from mapless_server.method.bundle.priors import NO_PRIORS, GravityPrior, Priors
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.features.extractors.turned import extract_turned
from mapless_server.method.features.rolls import Similarity
from mapless_server.method.features.views import Ignored, PosedView, View, view_of
from mapless_server.method.judge.answer import Localization
from mapless_server.method.judge.hypothesis import AS_IT_IS
from mapless_server.method.options import DoubtOptions, LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Advice, Rejection, RejectionReason
from mapless_server.scenes import ANYWHERE, Narrowing, Sphere
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.store import NewReference, Store
from research.all_features import describe_all

SCENE = SceneKey("corner")
TRUE = pose(2.0, -1.5)
REFERENCE_POSES = [pose(angle, height) for angle in (-10, -3, 5, 12) for height in (-1.8, -1.2)]
NAMED = tuple(f"r{i}" for i in range(len(REFERENCE_POSES)))
Localize = Callable[..., Result]


@dataclass
class UprightSift:
    """SIFT whose descriptors do not turn with the image."""

    name: str = "upright-sift"

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        sift = cv2.SIFT.create(nfeatures=1024, contrastThreshold=0.02, enable_precise_upscale=True)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        upright = [cv2.KeyPoint(it.pt[0], it.pt[1], it.size, 0.0, it.response, it.octave) for it in sift.detect(grey)]
        found, descriptors = sift.compute(grey, upright)
        sizes_px = np.array([it.size for it in found], np.float32)
        return view_of(camera, np.array([it.pt for it in found]), descriptors.astype(np.uint8), sizes_px)


@pytest.fixture(scope="module")
def localize(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Localize]:
    with localizing(tmp_path_factory.mktemp("store"), tiers()) as answer:
        yield answer


def tiers() -> list[Tier]:
    return [Tier(UprightSift(), Pipeline()), Tier(SiftExtractor(), Pipeline(), any_roll=True)]


@dataclass(frozen=True)
class Shot:
    """A photograph with its pose."""

    photo: Photo
    world_from_camera: RigidTransform


SHOTS = [Shot(Photo(photograph(it), CAMERA, "image"), it) for it in REFERENCE_POSES]


@contextmanager
def localizing(
    folder: Path,
    tiers: Sequence[Tier],
    doubtful_trust: float = 0.25,
    shots: Sequence[Shot] = SHOTS,
    described: int | None = None,
) -> Iterator[Localize]:
    """References of which so many have all features and vectors, None for all, and the others the first ones."""
    caller, loop = Caller(Flow("tenant", "client"), time.monotonic() + 600), asyncio.new_event_loop()
    with Store.open(folder) as store:
        options = EngineOptions(doubt=DoubtOptions(doubtful_trust))
        engine = engine_over(store, tiers, options)
        photos = [it.photo for it in shots]
        found_all = describe_all(engine, photos[:described])
        if left := photos[len(found_all) :]:
            found_all += loop.run_until_complete(engine.describe(left, caller))
        store.create_scene(SCENE)
        references = [
            NewReference(name, it.photo.image, it.photo.camera, it.world_from_camera, found.views, found.descriptors)
            for name, it, found in zip(NAMED, shots, found_all, strict=True)
        ]
        store.add_references(SCENE, references)

        def answer(
            image: bytes,
            camera: Camera,
            named: tuple[str, ...] = (),
            narrowing: Narrowing = ANYWHERE,
            priors: Priors = NO_PRIORS,
        ) -> Result:
            photo = Photo(image, camera, "image")
            asked = Query(SCENE, named, photo, narrowing, 8, LocalizeOptions(), priors=priors)
            return loop.run_until_complete(engine.run(engine.query_job(asked, caller)))

        yield answer
        loop.run_until_complete(engine.close())
    loop.close()


def rolled(
    image: NDArray[np.uint8], angle_deg: float, world_from_camera: RigidTransform = TRUE
) -> tuple[NDArray[np.uint8], Camera, RigidTransform]:
    """The photograph turned clockwise about its centre, all of it on black, with its camera and pose."""
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn, sides = np.array([[cos, -sin], [sin, cos]]), np.array([CAMERA.width_px, CAMERA.height_px])
    width, height = (int(it) for it in np.ceil(np.abs(turn) @ sides - 1e-6))
    new = (np.array([width, height]) - 1) / 2
    offset = new - turn @ ((sides - 1) / 2)
    turned = cv2.warpAffine(image, np.column_stack([turn, offset]), (width, height))
    x, y = turn @ (CAMERA.principal_x_px, CAMERA.principal_y_px) + offset
    camera = replace(CAMERA, width_px=width, height_px=height, principal_x_px=float(x), principal_y_px=float(y))
    old_from_turned = np.eye(3)
    old_from_turned[:2, :2] = turn.T
    rotation = world_from_camera.rotation @ old_from_turned
    return np.asarray(turned, np.uint8), camera, RigidTransform(rotation, world_from_camera.translation)


def held(world_from_camera: RigidTransform, orientation: int) -> Shot:
    """A photograph that is upright once a viewer has turned it as this EXIF orientation asks."""
    data = with_exif_orientation(encode(".jpg", textured(64, 64)), orientation)
    upright = decode_image(photograph(world_from_camera), ImageLimits())
    image, camera, pose = rolled(upright, -upright_of(data).clockwise_deg, world_from_camera)
    stored = np.ascontiguousarray(image[:, ::-1]) if upright_of(data).is_mirrored else image
    return Shot(Photo(with_exif_orientation(encode(".jpg", stored), orientation), camera, "image"), pose)


@pytest.fixture(scope="module")
def localize_held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Localize]:
    shots = [held(it, 1 + i % 8) for i, it in enumerate(REFERENCE_POSES)]
    with localizing(tmp_path_factory.mktemp("store"), tiers(), shots=shots) as answer:
        yield answer


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photographs_match_whichever_way_they_are_held(localize_held: Localize, orientation: int) -> None:
    shot = held(TRUE, orientation)
    result = localize_held(shot.photo.image, shot.photo.camera)
    assert isinstance(result.answer.outcome, Localization)
    off_m, off_deg = pose_error(result.answer.outcome.world_from_camera, shot.world_from_camera)
    assert off_m < 0.01
    assert off_deg < 0.2
    assert len(result.attempts) == 1


def test_a_false_orientation_costs_a_rung_and_no_answer(localize_held: Localize) -> None:
    shot = held(TRUE, 1)
    result = localize_held(with_exif_orientation(shot.photo.image, 8), shot.photo.camera)
    assert isinstance(result.answer.outcome, Localization)
    assert pose_error(result.answer.outcome.world_from_camera, TRUE)[0] < 0.01
    assert len(result.attempts) > 1


@pytest.mark.parametrize(
    ("angle_deg", "named"), [(90.0, NAMED), (180.0, ()), (270.0, ()), (37.0, ()), (225.0, NAMED)], ids=str
)
def test_a_turned_photograph_gets_the_pose_of_its_raster(
    localize: Localize, angle_deg: float, named: tuple[str, ...]
) -> None:
    image, camera, true = rolled(decode_image(photograph(TRUE), ImageLimits()), angle_deg)
    outcome = localize(encode(".png", image), camera, named).answer.outcome
    assert isinstance(outcome, Localization)
    off_m, off_deg = pose_error(outcome.world_from_camera, true)
    assert off_m < 0.01
    assert off_deg < 0.2


def test_features_of_all_rasters_are_the_strongest_first() -> None:
    image, found = decode_image(photograph(TRUE), ImageLimits()), SiftExtractor()
    one, other = (extract_turned(found, image, CAMERA, [angle_deg]) for angle_deg in (0.0, 90.0))
    both = extract_turned(found, image, CAMERA, (0.0, 90.0)).features
    np.testing.assert_allclose(both.keypoints[0:20:2], one.features.keypoints[:10])
    np.testing.assert_allclose(both.keypoints[1:20:2], other.features.keypoints[:10])


@pytest.mark.parametrize(
    ("agreeing", "is_part", "has_depths", "expected"),
    [
        ((64, 36, 4), False, False, 3.6),
        ((64,), False, False, 0.0),
        ((64, 4), True, False, 4.9),
        ((64, 4), False, True, 4.9),
    ],
)
def test_agreement_is_that_of_the_references_a_pose_needs(
    agreeing: tuple[int, ...], is_part: bool, has_depths: bool, expected: float
) -> None:
    found = [Similarity(0.0, it, 100) for it in agreeing]
    references = [SimpleNamespace(depths=object() if has_depths else None) for _ in agreeing]
    posed = cast(Sequence[PosedView], references)
    assert choosing.agreement_of(found, posed, is_part) == pytest.approx(expected)


def test_an_upright_photograph_is_not_tried_turned(localize: Localize) -> None:
    result = localize(photograph(TRUE), CAMERA, ())
    assert isinstance(result.answer.outcome, Localization)
    assert "turned" not in {it.rung for it in result.attempts}


def test_an_accepted_pose_of_little_trust_is_not_tried_turned(tmp_path: Path) -> None:
    with localizing(tmp_path, tiers(), doubtful_trust=1.1) as answer:
        result = answer(photograph(TRUE), CAMERA)
    assert isinstance(result.answer.outcome, Localization)
    assert "turned" not in [it.rung for it in result.attempts]


def test_a_photograph_found_beyond_its_limits_is_not_tried_turned(localize: Localize) -> None:
    result = localize(photograph(TRUE), CAMERA, NAMED, Narrowing(position=Sphere(TRUE.translation + 5.0, 1.0)))
    assert isinstance(result.answer.outcome, Rejection)
    assert result.answer.outcome.reason is RejectionReason.PRIOR_CONFLICT
    assert "turned" not in {it.rung for it in result.attempts}


def test_what_lacks_vectors_is_likely_by_the_photograph_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where its mirror image is matched, which not all features can be."""
    for name, seconds in (("MAKE_S", 0.0), ("LACKING_S", 600.0)):
        monkeypatch.setattr(f"mapless_server.engine.search.{name}", seconds)
    image = np.ascontiguousarray(decode_image(photograph(TRUE), ImageLimits())[:, ::-1])
    with localizing(tmp_path, tiers(), described=4) as localize:
        result = localize(encode(".png", image), CAMERA)
    assert "mirrored" in [it.rung for it in result.attempts]
    assert "failed" not in [it.outcome for it in result.attempts]
    assert {it.kind for it in result.missing} >= {"features", "retrieval"}


@pytest.mark.parametrize("named", [NAMED, ()], ids=["named", "chosen"])
def test_a_mirrored_photograph_is_rejected_as_mirrored(localize: Localize, named: tuple[str, ...]) -> None:
    image = np.ascontiguousarray(decode_image(photograph(TRUE), ImageLimits())[:, ::-1])
    mirrored = replace(CAMERA, principal_x_px=CAMERA.width_px - 1 - CAMERA.principal_x_px)
    outcome = localize(encode(".png", image), mirrored, named).answer.outcome
    assert isinstance(outcome, Rejection)
    assert outcome.reason is RejectionReason.GATE
    assert outcome.message.startswith("the photograph is mirrored")
    assert outcome.hint is not None
    assert outcome.hint.advice is Advice.CHECK_CALIBRATION


@pytest.mark.parametrize(
    ("as_it_is", "mirrored", "is_mirrored"),
    [(0, 0, False), (0, 20, True), (20, 45, False), (20, 70, True), (2000, 2900, False), (2000, 3000, True)],
)
def test_mirrored_is_what_matches_clearly_more(
    as_it_is: int, mirrored: int, is_mirrored: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half as much again, and not by chance, as 45 of 65 matches may be."""
    monkeypatch.setattr(choosing, "_most_matches", lambda search, views, tier: (mirrored, "r3"))
    photo = Photo(photograph(TRUE), CAMERA, "image")
    query = Query(SCENE, NAMED, photo, ANYWHERE, 8, LocalizeOptions())
    search = Search.begin(query, cast(Any, None), QueryViews(photo, ImageLimits()), time.monotonic() + 60)
    matched = cast(Any, SimpleNamespace(query_matches=(range(as_it_is), ())))
    found = choosing.mirrored(replace(search, material=matched), Tier(SiftExtractor(), Pipeline()))
    assert (found is not None) == is_mirrored
    if found is not None:
        assert found.hint is not None
        assert found.hint.best_reference == "r3"
        assert f"{mirrored} matches with a reference, as it is at most {as_it_is}" in found.message


def test_a_photograph_of_elsewhere_stays_rejected(localize: Localize) -> None:
    image = encode(".png", textured(CAMERA.width_px, CAMERA.height_px, seed=5))
    result = localize(image, CAMERA, ())
    assert isinstance(result.answer.outcome, Rejection)
    assert any(stage.endswith(MIRROR) for stage in result.stage_seconds)


@pytest.mark.parametrize("orientation", [1, 6, 8])
@pytest.mark.parametrize(
    ("angle_deg", "rung"), [(90.0, AS_IT_IS), (180.0, AS_IT_IS), (270.0, AS_IT_IS), (215.0, "turned")]
)
def test_a_gravity_prior_turns_a_photograph_by_quarters_at_once(
    tmp_path: Path, angle_deg: float, rung: str, orientation: int
) -> None:
    """By other angles after the first attempt; also against references that EXIF turns."""
    shots = [held(it, orientation) for it in REFERENCE_POSES]
    image, camera, true = rolled(decode_image(photograph(TRUE), ImageLimits()), angle_deg)
    down = np.array([0.0, 1.0, 0.0])
    prior = GravityPrior(true.rotation.T @ down, down, 2.0)
    with localizing(tmp_path, tiers()[:1], shots=shots) as answer:
        result = answer(encode(".png", image), camera, priors=Priors(gravity=prior))
    outcome = result.answer.outcome
    assert isinstance(outcome, Localization)
    assert [it.rung for it in result.attempts if it.is_chosen] == [rung]
    assert (len(result.attempts) == 1) == (rung == AS_IT_IS)
    off_m, off_deg = pose_error(outcome.world_from_camera, true)
    assert off_m < 0.03
    assert off_deg < 0.5


def test_a_gravity_prior_turns_a_photograph_as_the_references_are_held(tmp_path: Path) -> None:
    """All of them on their sides without EXIF, as a robot's camera may be mounted: a photograph held so stays so."""
    upright = [decode_image(photograph(it), ImageLimits()) for it in REFERENCE_POSES]
    turned = [rolled(image, 90.0, it) for image, it in zip(upright, REFERENCE_POSES, strict=True)]
    shots = [Shot(Photo(encode(".png", image), camera, "image"), at) for image, camera, at in turned]
    down = np.array([0.0, 1.0, 0.0])
    with localizing(tmp_path, tiers()[:1], shots=shots) as answer:
        for angle_deg, turn_deg in ((90.0, 0.0), (0.0, 90.0), (270.0, 180.0)):
            image, camera, true = rolled(decode_image(photograph(TRUE), ImageLimits()), angle_deg)
            prior = GravityPrior(true.rotation.T @ down, down, 2.0)
            result = answer(encode(".png", image), camera, priors=Priors(gravity=prior))
            assert isinstance(result.answer.outcome, Localization)
            assert [it.rung for it in result.attempts] == [AS_IT_IS]
            assert isinstance(result.answer.support, PosedSupport)
            assert result.answer.support.query.upright_deg == turn_deg


def test_a_false_gravity_prior_costs_a_rung_and_no_answer(localize: Localize) -> None:
    prior = GravityPrior(np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]), 2.0)
    result = localize(photograph(TRUE), CAMERA, priors=Priors(gravity=prior))
    assert isinstance(result.answer.outcome, Localization)
    assert pose_error(result.answer.outcome.world_from_camera, TRUE)[0] < 0.01
    assert len(result.attempts) == 2
    assert [it.conflict for it in result.answer.outcome.prior_checks] == [True]
