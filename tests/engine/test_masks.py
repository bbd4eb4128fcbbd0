"""Masks in a query's way: an overlay that all photographs carry is no evidence, and half a photograph is enough."""

import asyncio
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from support.compare import pose_error
from support.corner import CAMERA, photograph, pose
from support.images import encode, textured

from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Caller, Photo, Query, Result, Tier
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_image
from mapless_server.method.features.extractors import SiftExtractor
from mapless_server.method.judge.answer import Localization
from mapless_server.method.judge.hints import FEW_MATCHES
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pipeline import Pipeline
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.scenes import ANYWHERE
from mapless_server.scheduling import Flow
from mapless_server.security import SceneKey
from mapless_server.serve.assembly import engine_over
from mapless_server.store import NewReference, Store

Answer = Callable[[str, bytes, bytes], Result]
REFERENCE_POSES = [pose(angle, -1.6 + 0.1 * (i % 2)) for i, angle in enumerate((-25, -17, -9, -3, 3, 9, 17, 25))]
TRUE = pose(1.0, -1.5)
PLAIN, MASKED = "plain", "masked"

BADGE = np.zeros((CAMERA.height_px, CAMERA.width_px), bool)
BADGE[10:110, 10:170] = True
PATTERN = textured(CAMERA.width_px, CAMERA.height_px, seed=9)


def mask_of(ignored: np.ndarray) -> bytes:
    return encode(".png", np.repeat(np.where(ignored, 0, 255).astype(np.uint8)[..., None], 3, axis=2))


def badged(image: bytes) -> bytes:
    pixels = decode_image(image, ImageLimits())
    return encode(".png", np.where(BADGE[..., None], PATTERN, pixels))


@pytest.fixture(scope="module")
def localize(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Answer]:
    """Two scenes of the same place: as it is, and with a badge in every photograph that is masked."""
    caller, loop = Caller(Flow("tenant", "client"), time.monotonic() + 600), asyncio.new_event_loop()
    with Store.open(tmp_path_factory.mktemp("store")) as store:
        engine = engine_over(store, [Tier(SiftExtractor(), Pipeline())], EngineOptions())
        for scene in (PLAIN, MASKED):
            images = [photograph(it) if scene == PLAIN else badged(photograph(it)) for it in REFERENCE_POSES]
            mask = b"" if scene == PLAIN else mask_of(BADGE)
            photos = [Photo(it, CAMERA, "image", mask) for it in images]
            found = loop.run_until_complete(engine.describe(photos, caller))
            store.create_scene(SceneKey(scene))
            shown = enumerate(zip(photos, REFERENCE_POSES, found, strict=True))
            references = [
                NewReference(f"r{i}", p.image, CAMERA, at, it.views, it.descriptors, p.mask) for i, (p, at, it) in shown
            ]
            store.add_references(SceneKey(scene), references)

        def answer(scene: str, image: bytes, mask: bytes = b"") -> Result:
            photo = Photo(image, CAMERA, "image", mask)
            asked = Query(SceneKey(scene), (), photo, ANYWHERE, 8, LocalizeOptions())
            return loop.run_until_complete(engine.run(engine.query_job(asked, caller)))

        yield answer
        loop.run_until_complete(engine.close())
    loop.close()


def elsewhere() -> bytes:
    return badged(encode(".png", textured(CAMERA.width_px, CAMERA.height_px, seed=5)))


def test_another_place_with_the_same_badge_is_rejected_with_masks(localize: Answer) -> None:
    """Only the badge is the same, and no keypoint is in it."""
    result = localize(MASKED, elsewhere(), mask_of(BADGE))
    assert max(result.answer.reference_match_counts, default=0) < FEW_MATCHES
    assert isinstance(result.answer.outcome, Rejection)
    for reference in result.references:
        columns, rows = np.rint(reference.view.features.keypoints).astype(int).T
        assert len(columns) > 200
        assert not BADGE[rows, columns].any()


def test_the_place_itself_is_found_with_the_badge_masked(localize: Answer) -> None:
    outcome = localize(MASKED, badged(photograph(TRUE)), mask_of(BADGE)).answer.outcome
    assert isinstance(outcome, Localization)
    off_m, off_deg = pose_error(outcome.world_from_camera, TRUE)
    assert off_m < 0.01
    assert off_deg < 0.2


@pytest.mark.parametrize("half", ["left", "right"])
def test_half_a_photograph_gives_the_pose(localize: Answer, half: str) -> None:
    ignored = np.zeros_like(BADGE)
    middle = CAMERA.width_px // 2
    ignored[:, slice(middle) if half == "left" else slice(middle, None)] = True
    result = localize(PLAIN, photograph(TRUE), mask_of(ignored))
    outcome, support = result.answer.outcome, result.answer.support
    assert isinstance(outcome, Localization)
    off_m, off_deg = pose_error(outcome.world_from_camera, TRUE)
    assert off_m < 0.02
    assert off_deg < 0.3
    assert support is not None
    columns = support.query.features.keypoints[:, 0]
    assert columns.min() > middle if half == "left" else columns.max() < middle


def test_a_mask_that_ignores_nothing_changes_no_bit(localize: Answer) -> None:
    plain = localize(PLAIN, photograph(TRUE), b"").answer.outcome
    masked = localize(PLAIN, photograph(TRUE), mask_of(np.zeros_like(BADGE))).answer.outcome
    assert isinstance(plain, Localization)
    assert isinstance(masked, Localization)
    np.testing.assert_array_equal(plain.world_from_camera.matrix(), masked.world_from_camera.matrix())
    np.testing.assert_array_equal(plain.covariance, masked.covariance)


def test_a_mask_of_nearly_everything_is_named_in_the_hint(localize: Answer) -> None:
    inverted = np.ones_like(BADGE)
    inverted[:40, :40] = False
    for ignored, share in ((inverted, "99 %"), (np.ones_like(BADGE), "100 %")):
        outcome = localize(PLAIN, photograph(TRUE), mask_of(ignored)).answer.outcome
        assert isinstance(outcome, Rejection)
        assert outcome.reason is RejectionReason.LOW_TEXTURE
        assert outcome.hint is not None
        assert f"The mask ignores {share} of the image: 0 means ignore" in outcome.hint.message


def test_a_damaged_mask_is_refused_by_its_field(localize: Answer) -> None:
    with pytest.raises(InvalidArgument, match="mask") as raised:
        localize(PLAIN, photograph(TRUE), mask_of(BADGE)[:-40])
    assert raised.value.field == "mask"
