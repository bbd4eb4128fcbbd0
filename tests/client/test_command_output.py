"""The terminal's text for people, and small cases of the command's arguments."""

import json
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from support.planted_answers import diagnostics, localized, rejected, truth

from mapless import wire
from mapless.answers import Accuracy, LocalizationResult, PriorCheck, Rejected
from mapless.axes import Axes, pose_to
from mapless.cameras import read_camera
from mapless.cli.arguments import make_parser
from mapless.cli.localize import priors
from mapless.cli.output import line, plain
from mapless.diagnostics import DepthCheck, MissingEvidence
from mapless.geometry import Camera, RigidTransform, Similarity
from mapless.groups import GroupRejected, RigLocalization, SequenceLocalization, TrackingJump
from mapless.lenses import Fisheye
from mapless.priors import Priors
from mapless.requests import read_image
from mapless.results import PendingWork, summary_of
from mapless.used_intrinsics import IntrinsicsCheck
from mapless.v1 import localization_service_pb2 as pb


def lines(answer: LocalizationResult | Rejected) -> list[str]:
    return str(answer).splitlines()


def test_each_prior_has_its_line() -> None:
    checks = (
        PriorCheck("GRAVITY", 0.7, 2, False, True),
        PriorCheck("HEADING", 0.7, 2, False, False),
        PriorCheck("POSITION", 8.04, 3, True, False),
    )
    assert [line.strip() for line in lines(localized(prior_checks=checks)) if "prior" in line] == [
        "prior     GRAVITY agrees, used",
        "prior     HEADING agrees, less certain than the photograph, not needed",
        "prior     POSITION contradicts the photograph: 8.0 standard deviations, not used",
    ]


def test_a_corrected_parameter_of_the_camera_has_its_line() -> None:
    checks = (
        IntrinsicsCheck("FOCAL_LENGTH", 525.0, 530.3, 0.8, 1.6, False, True),
        IntrinsicsCheck("PRINCIPAL_X", 320.0, 320.9, 0.8, 1.9, False, True),
        IntrinsicsCheck("K1", 0.0, 0.02, 0.05, 0.01, False, False),
    )
    assert [it.strip() for it in lines(localized(intrinsics_checks=checks)) if it.startswith("  camera")] == [
        "camera    focal_x_px is 525.0, the photograph says 530.3 +- 0.8: used"
    ]


def test_what_references_lack_is_one_line_for_doubtful_answers() -> None:
    missing = (
        MissingEvidence("features", "edgepoint2", 31, 1),
        MissingEvidence("features", "aliked", 28),
        MissingEvidence("retrieval", "of aliked", 31, 31),
        MissingEvidence("matches", "aliked (network)", 29),
        MissingEvidence("calibration", "auto", 30),
    )
    lacking = replace(diagnostics(), missing_evidence=missing)
    line = "30 references still lack features for further attempts, 29 matches with one another; ask again later"
    assert lines(rejected(diagnostics=lacking))[-1] == f"  {line}"
    assert f"  missing   {line}" in lines(localized(diagnostics=lacking, trust=0.01))
    assert not any("missing" in it for it in lines(localized(diagnostics=lacking, trust=0.9)))


def test_pending_work_is_short_and_without_internal_names() -> None:
    pending = [
        PendingWork("matches", "a (nearest)", 30),
        PendingWork("features", "b", 30),
        PendingWork("features", "c", 7),
    ]
    assert summary_of(pending) == "matches of 30 references, features of 30 references"


def test_an_arbitrary_unit_is_not_called_metres() -> None:
    printed = lines(localized(arbitrary_unit=True))
    assert printed[-1] == "  warning   the scene's unit of length is arbitrary, not the metre"
    (position,) = (it for it in printed if it.startswith("  position"))
    assert " units   within 0.02 units (68 %), 0.04 units (95 %, uncalibrated)" in position
    assert " units " in line("a.jpg", localized(arbitrary_unit=True))
    assert " cm " in line("a.jpg", localized())


def test_low_trust_is_warned_of() -> None:
    warning = "  warning   fewer than 15 % of right answers look as doubtful: check the intrinsics, "
    assert lines(localized(trust=0.149))[-1] == f"{warning}take another photograph, or ask for --coverage 0.85"
    for trust in (0.15, 0.9, None):
        assert not [line for line in lines(localized(trust=trust)) if "warning" in line]


@pytest.mark.parametrize(
    ("is_final", "first"), [(False, "coarse pose; the final answer follows"), (True, "coarse pose")]
)
def test_a_coarse_pose_is_not_called_localized(is_final: bool, first: str) -> None:
    coarse = localized(
        pose_stage="COARSE", covariance=None, accuracy=None, trust=None, prior_checks=(), is_final=is_final, debug=None
    )
    printed = lines(coarse)
    assert printed[0] == first
    assert printed[-1] == "  support   not verified, 0.30 s"
    assert not [line for line in printed if "within" in line]


@pytest.mark.parametrize(
    ("check", "text"),
    [
        (
            DepthCheck(900, 90, 88, 1.012, 0.002, False, True),
            "88 of 90 agree, 1.012 (+- 0.2 %) times the pose's: used",
        ),
        (
            DepthCheck(900, 90, 9, 998.0, 0.3, True, False),
            "998 (+- 30 %) times the pose's: contradicts",
        ),
        (DepthCheck(900, 90, 88, 1.0, 0.002, False, False), "pose's: not needed"),
        (DepthCheck(900, 90, 88, 1.0, 0.002, False, True, 2.0, 34), "pose's: gives 34 of the points"),
        (DepthCheck(900, 0, 0, 0.0, 0.0, False, True, 2.0, 509), "900 keypoints have one, gives 509 of the points"),
        (DepthCheck(900, 0, 0, 0.0, 0.0, True, False, 1880.0), "its median is 1880 m, outside 0.05 to 200 m: not used"),
        (DepthCheck(900, 3, 0, 0.0, 0.0, False, False, 2.0), "900 keypoints have one, too few to compare (3)"),
        (DepthCheck(900, 3, 0, 0.0, 0.0, False, False), "900 keypoints have one, too few to compare (3)"),
    ],
)
def test_the_photographs_depth_has_its_line(check: DepthCheck, text: str) -> None:
    answer = localized(diagnostics=replace(diagnostics(), depth_check=check))
    (found,) = (line for line in lines(answer) if line.startswith("  depth "))
    assert text in found
    assert not any(line.startswith("  depth ") for line in lines(localized()))


def test_points_are_counted_by_what_gives_their_distance() -> None:
    assert "  points    130 triangulated, 50 by measured depth" in lines(localized())


def test_a_rejection_names_the_reference_that_shares_most() -> None:
    assert lines(rejected())[-1] == "  shares most with reference a"
    hint = rejected().hint
    assert hint is not None
    assert lines(rejected(hint=replace(hint, best_reference="")))[-1] == "  Point the camera there."


def test_capture_is_announced_only_where_it_is_on() -> None:
    captured = replace(diagnostics(), captured=True)
    assert "  support   180 of 200 matches, 2 references, 0.30 s, captured by the server" in lines(
        localized(diagnostics=captured)
    )
    assert lines(rejected(diagnostics=captured))[-1] == "  captured by the server"
    assert "captured" not in "\n".join([*lines(localized()), *lines(rejected())])


def test_zeros_are_printed_and_what_is_absent_is_not() -> None:
    answer = localized(world_from_camera=RigidTransform.identity())
    pose = plain(answer)["world_from_camera"]
    assert pose == {"rotation": {"x": 0, "y": 0, "z": 0, "w": 1}, "translation_m": {"x": 0, "y": 0, "z": 0}}
    pinhole = Camera(640, 480, 500.0, 500.0, 0.0, 0.0)
    assert {*plain(pinhole)} == {it.name for it in fields(Camera)} - {"distortion"}
    assert plain(replace(pinhole, distortion=Fisheye(k2=0.1)))["fisheye"] == {"k1": 0, "k2": 0.1, "k3": 0, "k4": 0}
    assert read_camera(json.dumps(plain(pinhole))) == pinhole


def test_text_of_a_group_is_its_pose_or_its_reason() -> None:
    answer, spread = localized(), 1e-4 * np.eye(6)
    assert answer.accuracy is not None
    common = spread, answer.accuracy, 180, 200, 0.5, ()
    assert str(RigLocalization(truth(), *common, trust=0.9)).splitlines() == [
        "rig localized, trust 0.900: 180 of 200 matches, 0 photographs",
        *lines(answer)[1:3],
    ]
    moved = SequenceLocalization(
        Similarity(1.0, np.eye(3), np.zeros(3)),
        0.0,
        (truth(),),
        *common,
        "OPENCV",
        jumps=(TrackingJump(3, 4, 0.25, 2.0),),
    )
    assert str(moved).splitlines()[1:] == [
        *lines(answer)[1:3],
        "  jump      between photographs 3 and 4: 0.25 m, 2 deg",
    ]
    turned = replace(answer, world_from_camera=pose_to(Axes.ROS, truth()), in_axes=None)
    assert str(replace(moved, axes="ROS", jumps=())).splitlines() == [
        "sequence localized: 180 of 200 matches, 0 photographs   in ROS axes",
        *lines(turned)[1:3],
    ]
    assert str(GroupRejected("GATE", "No.", (), rejected().hint)).splitlines() == lines(
        replace(rejected(), reason="GATE", message="No.")
    )


def test_priors_of_the_command_are_those_of_the_client() -> None:
    pose = '{"rotation": {"w": 1}, "translation_m": {"x": 1}}'
    flags = "--near 1 2 3 4 --looking 0 0 1 30 --geo-position 47 8 5 --gravity 0 1 0 --gravity-sigma 2"
    given = make_parser().parse_args(["localize", "hall", "a.jpg", *flags.split(), "--pose-prior", pose, "0.1", "3"])
    found = priors(given)
    assert all(getattr(found, it.name) is not None for it in fields(Priors))
    assert found.pose is not None
    assert found.pose.world_from_camera.translation.tolist() == [1, 0, 0]
    np.testing.assert_allclose(np.sqrt(np.diag(found.pose.covariance)), [0.1] * 3 + [np.radians(3)] * 3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (["[[1]]", "1", "1"], "--pose-prior: pose: world_from_camera as a matrix: must be 3 or 4 rows"),
        (["{}", "a", "1"], "METRES and DEGREES of --pose-prior must be numbers, are 'a' and '1'"),
        (['{"rotation": {"w": 1}, "translation_m": {}}', "1", "0"], "rotation_sigma_deg must be above 0, is 0"),
    ],
)
def test_wrong_parts_of_a_pose_prior_are_named(values: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        priors(make_parser().parse_args(["localize", "hall", "a.jpg", "--pose-prior", *values]))


def test_axes_that_are_none_are_named_among_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"Axes must be one of opencv, .* is 'Blender'"):
        wire.enum_value(pb.Axes, "Blender")
    assert wire.enum_value(pb.Axes, "") == 0


def test_pixels_are_to_be_encoded_first() -> None:
    with pytest.raises(TypeError, match=r"not numpy\.ndarray: encode pixels first"):
        read_image(np.zeros((4, 4, 3), np.uint8))  # type: ignore[arg-type]


def test_of_a_folders_cameras_that_of_the_photograph_is_read(tmp_path: Path) -> None:
    file = tmp_path / "cameras.json"
    frame = {"image": "a.jpg", "width": 640, "height": 480, "K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]]}
    file.write_text(json.dumps({"frames": [frame, frame | {"image": "b.jpg", "width": 600}]}))
    assert read_camera(file, tmp_path / "b.jpg") == Camera(600, 480, 500.0, 500.0, 320.0, 240.0)
    with pytest.raises(ValueError, match="a single camera is needed"):
        read_camera(file)
    with pytest.raises(ValueError, match=r"cameras\.json does not list .*c\.jpg"):
        read_camera(file, tmp_path / "c.jpg")


@pytest.mark.parametrize(
    ("radius_m", "unit", "shown"),
    [(0.0082, "m", "within 0.82 cm (68 %), 1.6 cm"), (1.4, "m", "within 1.4 m (68 %), 2.8 m")]
    + [(0.7, "m", "within 70 cm (68 %), 140 cm"), (612.0, "units", "within 612 units (68 %), 1224 units")],
)
def test_radii_have_a_unit_that_suits_their_size(radius_m: float, unit: str, shown: str) -> None:
    accuracy = Accuracy(radius_m, 2 * radius_m, 0.1, 0.2, calibrated=False)
    assert accuracy.text("position", unit) == f"{shown} (95 %, uncalibrated)"
