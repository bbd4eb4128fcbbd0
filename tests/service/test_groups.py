"""LocalizeRig and LocalizeSequence through a real server: requests, answers, refusals."""

import math
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime, timezone
from unittest.mock import Mock

import numpy as np
import pytest
from support.compare import assert_pose_close
from support.corner import make_corner, photograph
from support.corner import pose as corner_pose
from support.images import encode
from support.servers import pose, serving_really

from mapless import (
    Camera,
    Client,
    GroupRejected,
    HeadingPrior,
    NewReference,
    NotFound,
    PosePrior,
    PositionPrior,
    Priors,
    RigidTransform,
    RigImage,
    RigLocalization,
    SequenceFrame,
    SequenceLocalization,
)
from mapless.axes import Axes, pose_to
from mapless.calls import groups
from mapless.geometry import rotation_from_vector
from mapless.messages import sequence_from_message

CORNER = Camera(320, 240, 280.0, 280.0, 160.3, 118.9)
STANDPOINTS = [corner_pose(-15.0 + 6 * i, height_m=-1.6 + 0.05 * (i % 2)) for i in range(6)]
WALK = [corner_pose(-10.0 + 5 * i, height_m=-1.58 - 0.01 * i, distance_m=3.3) for i in range(4)]
BLANK = encode(".png", np.full((240, 320, 3), 90, np.uint8))


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    with serving_really(tmp_path_factory.mktemp("corner"), workers=1) as server, Client(server.address) as client:
        make_corner(client, STANDPOINTS, camera=CORNER)
        yield client


@pytest.fixture(scope="module")
def queries() -> list[bytes]:
    return [photograph(it, CORNER) for it in WALK]


WORLD_FROM_RIG = RigidTransform(rotation_from_vector([0.4, 0.2, -1.0]), np.array([0.5, 0.3, 0.9]))
RIG_FROM_CAMERA = [WORLD_FROM_RIG.inverse().compose(it) for it in WALK]


def as_rig(images: list[bytes]) -> list[RigImage]:
    return [RigImage(image, CORNER, fixed) for image, fixed in zip(images, RIG_FROM_CAMERA, strict=True)]


def test_a_rig(corner: Client, queries: list[bytes]) -> None:
    """Its answer in full; one of its photographs is blank."""
    taken = datetime(2026, 1, 2, 3, 4, 5, tzinfo=timezone.utc)
    images = as_rig([queries[0], BLANK, queries[2], queries[3]])
    answer = corner.localize_rig(images, "corner", capture_time=taken, session_from_rig=pose(7.0))
    assert isinstance(answer, RigLocalization), answer
    assert_pose_close(answer.world_from_rig, WORLD_FROM_RIG, metres=0.01, degrees=0.5)
    assert answer.world_from_session is not None
    assert_pose_close(answer.world_from_session.compose(pose(7.0)), answer.world_from_rig, metres=1e-9, degrees=1e-6)
    assert answer.capture_time == taken
    assert (answer.geo_pose, answer.arbitrary_unit) == (None, False)
    assert 0 < answer.accuracy.position_68_m < answer.accuracy.position_95_m < 0.2
    assert (np.linalg.eigvalsh(answer.covariance) > 0).all()
    assert answer.trust is not None
    assert 0 < answer.trust <= 1
    assert [report.rejected_alone for report in answer.images] == [None, "LOW_TEXTURE", None, None]
    assert sum(report.inlier_count for report in answer.images) == answer.inlier_count <= answer.match_count
    assert answer.images[1].match_count == 0
    for report in (answer.images[0], answer.images[2]):
        assert max(use.inlier_count for use in report.diagnostics.references) > 10
        assert {"features", "pnp"} <= set(report.diagnostics.stage_s)
        assert 0 <= report.diagnostics.queue_s <= report.diagnostics.total_s


def test_rigs_and_sequences_say_that_the_unit_is_arbitrary(corner: Client, queries: list[bytes]) -> None:
    frames = [SequenceFrame(image, CORNER, at) for image, at in zip(queries[:2], WALK, strict=False)]
    corner.update_scene("corner", arbitrary_unit=True)
    try:
        rig = corner.localize_rig(as_rig(queries)[:2], "corner")
        sequence = corner.localize_sequence(frames, "corner")
    finally:
        corner.update_scene("corner", arbitrary_unit=False)
    assert isinstance(rig, RigLocalization)
    assert isinstance(sequence, SequenceLocalization)
    assert rig.arbitrary_unit
    assert sequence.arbitrary_unit


def test_soft_priors_of_another_place_do_not_cost_the_answer(corner: Client, queries: list[bytes]) -> None:
    """The references are then those of the whole scene, and the priors are said to be wrong; a hard one stays."""
    there = [RigidTransform(it.rotation, it.translation + [100.0, 0.0, 0.0]) for it in WALK[:2]]
    noise = np.random.default_rng(0).integers(0, 255, (len(there), 240, 320, 3), np.uint8)
    shown = [encode(".png", it) for it in noise]
    corner.add_references(
        "corner", [NewReference(f"far{i}", it, CORNER, at) for i, (it, at) in enumerate(zip(shown, there, strict=True))]
    )
    soft = [Priors(pose=PosePrior.from_sigmas(at, 0.5, 5.0)) for at in there]
    hard = Priors(position=PositionPrior(there[0].translation, 5.0))
    try:
        images = [replace(it, priors=prior) for it, prior in zip(as_rig(queries)[:2], soft, strict=True)]
        rig = corner.localize_rig(images, "corner")
        frames = [
            SequenceFrame(image, CORNER, at, priors=p) for image, at, p in zip(queries[:2], WALK[:2], soft, strict=True)
        ]
        sequence = corner.localize_sequence(frames, "corner")
        limited = corner.localize_rig([replace(as_rig(queries)[0], priors=hard)], "corner")
    finally:
        for i in range(len(there)):
            corner.delete_reference("corner", f"far{i}")
    assert isinstance(rig, RigLocalization), rig
    assert_pose_close(rig.world_from_rig, WORLD_FROM_RIG, metres=0.01, degrees=0.5)
    assert all(check.conflict for report in rig.images for check in report.prior_checks)
    assert isinstance(sequence, SequenceLocalization), sequence
    assert_pose_close(sequence.world_from_camera[-1], WALK[1], metres=0.01, degrees=0.5)
    assert isinstance(limited, GroupRejected)


@pytest.mark.parametrize("axes", ["", "unity"])
def test_a_sequence(corner: Client, queries: list[bytes], axes: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The device's tracked poses, in its own axes and its own unit."""
    parse = Mock(wraps=sequence_from_message)
    monkeypatch.setattr(groups, "sequence_from_message", parse)
    name = Axes(axes or "opencv")
    session_from_world = RigidTransform(rotation_from_vector([0.1, -0.3, 0.2]), np.array([3.0, 1.0, -2.0]))

    def tracked(world_from_camera: RigidTransform) -> RigidTransform:
        metric = session_from_world.compose(world_from_camera)
        return pose_to(name, RigidTransform(metric.rotation, metric.translation / 0.5))

    taken = datetime(2026, 1, 2, tzinfo=timezone.utc)
    frames = [
        SequenceFrame(image, CORNER, tracked(at), taken if i == 2 else None)
        for i, (image, at) in enumerate(zip(queries, WALK, strict=True))
    ]
    answer = corner.localize_sequence(frames, "corner", estimate_session_scale=True, axes=axes)
    assert isinstance(answer, SequenceLocalization), answer
    for found, truth in zip(answer.world_from_camera, WALK, strict=True):
        assert_pose_close(found, truth, metres=0.01, degrees=0.5)
    assert answer.axes == name.name
    assert answer.world_from_session.scale == pytest.approx(0.5, rel=0.1)
    assert 0 < answer.scale_sigma < 0.05
    now = answer.world_from_session.transform_pose(tracked(WALK[-1]))
    assert_pose_close(now, pose_to(name, answer.world_from_camera[-1]), metres=1e-6, degrees=1e-4)
    assert [report.rejected_alone for report in answer.images] == [None] * 4
    poses = parse.call_args.args[0].localization.poses
    assert [it.HasField("capture_time") for it in poses] == [False, False, True, False]


def test_a_jump_of_the_tracking_is_reported(corner: Client, queries: list[bytes]) -> None:
    """Between the two last photographs; one of them has priors."""
    jump = RigidTransform(rotation_from_vector([0, 0.3, 0]), np.array([0.0, 2.0, 0.0]))
    session = [*WALK[:3], jump.compose(WALK[3])]
    known = Priors(heading=HeadingPrior(WALK[3].rotation[:, 2], sigma_deg=1.0))
    frames = [SequenceFrame(image, CORNER, at) for image, at in zip(queries, session, strict=True)]
    frames[3] = replace(frames[3], priors=known)
    answer = corner.localize_sequence(frames, "corner")
    assert isinstance(answer, SequenceLocalization), answer
    (found,) = answer.jumps
    assert (found.before, found.after) == (2, 3)
    assert found.shift_m == pytest.approx(math.dist(session[3].translation, WALK[3].translation), abs=0.05)
    assert found.rotation_deg == pytest.approx(math.degrees(0.3), abs=0.5)
    for pose_found, truth in zip(answer.world_from_camera, WALK, strict=True):
        assert_pose_close(pose_found, truth, metres=0.01, degrees=0.5)
    assert answer.trust is not None
    assert 0 < answer.trust <= 1
    assert [(it.kind, it.conflict) for it in answer.images[3].prior_checks] == [("HEADING", False)]
    frames[3] = replace(frames[3], priors=Priors(position=PositionPrior(WALK[3].translation + 5.0, radius_m=1.0)))
    rejected = corner.localize_sequence(frames, "corner")
    assert isinstance(rejected, GroupRejected)
    assert rejected.reason == "PRIOR_CONFLICT"


def test_what_shows_nothing_is_rejected_with_each_images_reason(corner: Client) -> None:
    answer = corner.localize_rig(as_rig([BLANK] * 4)[:2], "corner")
    assert isinstance(answer, GroupRejected)
    assert answer.reason == "LOW_TEXTURE"
    assert answer.hint is not None
    assert answer.hint.advice == "RETAKE_PHOTOGRAPH"
    assert [report.rejected_alone for report in answer.images] == ["LOW_TEXTURE"] * 2


def test_references_may_be_named_for_each_image(corner: Client, queries: list[bytes]) -> None:
    image = RigImage(queries[0], CORNER, RIG_FROM_CAMERA[0], ("r0", "r1", "r2"))
    answer = corner.localize_rig([image, image], "corner")
    assert isinstance(answer, RigLocalization)
    names = [[use.name for use in report.diagnostics.references] for report in answer.images]
    assert names == [[f"scenes/corner/references/r{i}" for i in range(3)]] * 2
    with pytest.raises(NotFound) as caught:
        corner.localize_rig([image, RigImage(queries[0], CORNER, RIG_FROM_CAMERA[0], ("r0", "absent"))], "corner")
    assert caught.value.field == "images[1].references[1]"
