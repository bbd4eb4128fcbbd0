"""Tracking, on photographs of a rendered corner: the prior saves time, and decides nothing that it should not."""

import asyncio
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.compare import pose_error
from support.corner import CAMERA, photograph, pose
from support.images import encode, textured

from mapless.geometry import RigidTransform, rotation_from_vector
from mapless_server.engine import choosing
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import TRACK, Caller, Photo, Query, Result, Tier
from mapless_server.errors import DataLoss
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.method.bundle.priors import NO_PRIORS, HeadingPrior, PosePrior, PositionPrior, Priors
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.judge.answer import Localization
from mapless_server.method.options import LocalizeOptions, Variant
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Advice, Rejection, RejectionReason
from mapless_server.scenes import Narrowing
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.store import NewReference, Store

SCENE, COPIED, TWO_PLACES = SceneKey("corner"), SceneKey("copies"), SceneKey("places")
TRUE, IDENTITY = pose(2.0, -1.5), RigidTransform(np.eye(3), np.zeros(3))
COPY = RigidTransform(np.eye(3), np.array([5.0, 0.0, 0.0]))
AWAY_M = np.array([100.0, 0.0, 0.0])
SIGMA_M, SIGMA_DEG = 0.05, 1.5
Localize = Callable[..., Result]


def prior(at: RigidTransform = TRUE, sigma_deg: float = SIGMA_DEG, sigma_m: float = SIGMA_M) -> Priors:
    deviations = [sigma_m] * 3 + [np.radians(sigma_deg)] * 3
    return Priors(pose=PosePrior(at, np.diag(np.square(deviations))))


def moved(metres: float, degrees: float) -> RigidTransform:
    turn = rotation_from_vector(np.radians(degrees) * np.array([0.0, 1.0, 0.0]))
    return RigidTransform(turn @ TRUE.rotation, TRUE.translation + [metres, 0.0, 0.0])


def query(priors: Priors = NO_PRIORS, scene: SceneKey = SCENE, image: bytes = b"", **named: object) -> Query:
    values = {"reference_ids": (), "narrowing": Narrowing.of(priors), "reference_count": 10} | named
    options = values.pop("options", LocalizeOptions())
    return Query(scene, photo=Photo(image, CAMERA, "image"), options=options, priors=priors, **values)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def localize(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Localize]:
    """A scene of a corner, one in which a copy of it stands 5 m aside, and one with another place 100 m away."""
    caller = Caller(Flow("tenant", "client"), time.monotonic() + 600)
    folder: Path = tmp_path_factory.mktemp("store")
    poses = [pose(angle, height) for angle in (-15, -5, 5, 15) for height in (-1.8, -1.2)]
    image, loop = photograph(TRUE), asyncio.new_event_loop()
    with Store.open(folder) as store:
        engine = engine_over(store, [Tier(SiftExtractor(), Pipeline())], EngineOptions())
        photos = [Photo(photograph(it), CAMERA, "image") for it in poses]
        described = loop.run_until_complete(engine.describe(photos, caller))

        def added(scene: SceneKey, places: Sequence[RigidTransform]) -> None:
            store.create_scene(scene)
            for k, place in enumerate(places):
                shown = zip(photos, poses, described, strict=True)
                references = [
                    NewReference(f"{k}-{i}", photo.image, CAMERA, place.compose(at), found.views, found.descriptors)
                    for i, (photo, at, found) in enumerate(shown)
                ]
                store.add_references(scene, references)

        added(SCENE, [IDENTITY])
        added(COPIED, [IDENTITY, COPY])
        added(TWO_PLACES, [IDENTITY])
        others = [Photo(encode(".png", textured(512, 384, seed=i)), CAMERA, "image") for i in range(4)]
        away = zip(others, poses[::2], loop.run_until_complete(engine.describe(others, caller)), strict=True)
        store.add_references(
            TWO_PLACES,
            [
                NewReference(f"away-{i}", photo.image, CAMERA, at.shifted(AWAY_M), found.views, found.descriptors)
                for i, (photo, at, found) in enumerate(away)
            ],
        )

        def answer(priors: Priors = NO_PRIORS, scene: SceneKey = SCENE, **named: object) -> Result:
            job = engine.query_job(query(priors, scene, image, **named), caller)
            return loop.run_until_complete(engine.run(job))

        yield answer
        loop.run_until_complete(engine.close())
    loop.close()


def localized(result: Result) -> Localization:
    assert isinstance(result.answer.outcome, Localization)
    return result.answer.outcome


def test_a_right_prior_gives_the_same_pose_within_its_radius(localize: Localize) -> None:
    full, tracked = localize(), localize(prior())
    assert (full.is_tracked, tracked.is_tracked) == (False, True)
    assert tracked.processed.width_px < full.processed.width_px
    found = localized(tracked)
    assert found.covariance is not None
    radii = accuracy_from_covariance(found.covariance)
    for true in (TRUE, localized(full).world_from_camera):
        metres, degrees = pose_error(found.world_from_camera, true)
        assert metres <= radii.position_95_m
        assert degrees <= radii.rotation_95_deg


@pytest.mark.parametrize(("metres", "degrees"), [(0.3, 0.0), (0.0, 10.0)])
def test_a_wrong_prior_gives_the_answer_without_it(localize: Localize, metres: float, degrees: float) -> None:
    full, misled = localize(), localize(prior(moved(metres, degrees)))
    assert not misled.is_tracked
    assert TRACK in misled.stage_seconds
    assert localized(misled).prior_checks[0].conflict
    np.testing.assert_allclose(
        localized(misled).world_from_camera.matrix(), localized(full).world_from_camera.matrix(), atol=1e-9
    )


@pytest.mark.parametrize("copy", [0, 1])
def test_a_tight_prior_decides_between_two_copies(localize: Localize, copy: int) -> None:
    true = COPY.compose(TRUE) if copy else TRUE
    for sigma_m in (SIGMA_M, 1e-3):
        result = localize(prior(true, sigma_m=sigma_m), COPIED)
        metres, degrees = pose_error(localized(result).world_from_camera, true)
        assert (metres < 0.02, degrees < 0.3) == (True, True)
        assert {it.name.rpartition("/")[2][0] for it in result.references} == {str(copy)}
        assert not localized(result).prior_checks[0].conflict


@pytest.mark.parametrize(
    ("priors", "advice", "said"),
    [
        (NO_PRIORS, Advice.TELL_PLACES_APART, "Give a prior"),
        (prior(TRUE.shifted([0, -1.0, 0])), Advice.CHECK_PRIOR, "neither of the two places."),
        (prior(TRUE.shifted([0, -0.33, 0])), Advice.CHECK_PRIOR, "neither of the two places well"),
        (prior(sigma_m=5.0, sigma_deg=15.0), Advice.TELL_PLACES_APART, "fits both"),
    ],
    ids=["none", "neither", "hardly one", "both"],
)
def test_a_prior_of_both_or_neither_copy_leaves_two(
    localize: Localize, priors: Priors, advice: Advice, said: str
) -> None:
    outcome = localize(priors, COPIED).answer.outcome
    assert isinstance(outcome, Rejection)
    assert outcome.reason is RejectionReason.AMBIGUOUS
    assert outcome.hint is not None
    assert (outcome.hint.advice, said in outcome.hint.message) == (advice, True)


@pytest.mark.parametrize(
    "priors",
    [
        prior(TRUE.shifted(AWAY_M)),
        Priors(position=PositionPrior(TRUE.translation + AWAY_M, np.eye(3))),
        Priors(heading=HeadingPrior.looking(-TRUE.rotation[:, 2], 1.0)),
    ],
    ids=["pose", "position", "heading"],
)
def test_a_prior_of_another_place_gives_the_answer_without_it(localize: Localize, priors: Priors) -> None:
    found = localized(localize(priors, TWO_PLACES))
    assert found.prior_checks[0].conflict
    free = localized(localize(NO_PRIORS, TWO_PLACES))
    np.testing.assert_allclose(found.world_from_camera.matrix(), free.world_from_camera.matrix(), atol=1e-9)


def test_a_rejection_near_the_prior_leads_to_the_whole_scene(localize: Localize) -> None:
    """Also if the reference that resembles the photograph most is near: here it alone is, which gives no points."""
    free = localize()
    assert free.choice is not None
    alike = free.choice.references[0].world_from_camera.translation
    priors = Priors(position=PositionPrior(alike, 1e-4 * np.eye(3)))
    near = localize(priors, narrowing=replace(Narrowing.of(priors), margin_m=0.01))
    np.testing.assert_allclose(
        localized(near).world_from_camera.matrix(), localized(free).world_from_camera.matrix(), atol=1e-9
    )


def test_a_search_elsewhere_that_fails_costs_no_answer(localize: Localize, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> bool:
        raise DataLoss("damaged")

    monkeypatch.setattr(choosing, "_outside", fails)
    assert isinstance(localize(prior(TRUE.shifted(AWAY_M)), TWO_PLACES).answer.outcome, Rejection)
    localized(localize(Priors(position=PositionPrior(TRUE.translation, np.eye(3)))))


def test_what_leaves_the_references_open_is_not_tracked() -> None:
    assert query(prior()).can_be_tracked
    assert not query().can_be_tracked
    assert not query(prior(sigma_deg=21.0)).can_be_tracked
    assert not query(prior(), reference_ids=("r0",)).can_be_tracked
    assert not query(prior(), is_part=True).can_be_tracked
    assert not query(prior(), options=LocalizeOptions(variant=Variant.FULL)).can_be_tracked
