"""A robot's localizer without ROS and without a server: answers and odometry are planted."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from support.bags import BASE_FROM_CAMERA, at, drive, image, pose_with_covariance
from support.images import textured
from support.servers import CAMERA

from mapless import InvalidArgument, Rejected, RigidTransform, Unavailable
from mapless.answers import Accuracy
from mapless.geometry import Similarity, rotation_angle_deg, rotation_from_vector
from mapless.groups import ImageReport, SequenceFrame, SequenceLocalization
from mapless.requests import IntrinsicsUncertainty
from mapless.ros import Localizer, LocalizerOptions, RosCamera, pose_of_body

MAP_FROM_ODOM = RigidTransform(rotation_from_vector([0.0, 0.0, 1.2]), np.array([5.0, -3.0, 0.1]))
COVARIANCE = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])
ABOUT: dict[str, Any] = {"depth_check": None, "searched_scene_count": 1, "adoption": ""}


class PlantedClient:
    """Answers with the true pose, or what is planted; keeps what it was given."""

    def __init__(self) -> None:
        self.priors: list[Any] = []
        self.plant: Any = None
        self.scene = "scenes/hall"
        self.where: list[Any] = []

    def localize(self, photo: bytes, camera: Any, scene: str, *, priors: Any, capture_time: Any, **given: Any) -> Any:
        self.priors.append(priors.pose)
        self.where.append((scene, *(given[it] for it in ("scenes", "group", "prior_scene"))))
        if isinstance(self.plant, Exception):
            raise self.plant
        about = SimpleNamespace(
            request_id="r",
            total_s=0.2,
            queue_s=0.0,
            references=(),
            depth_check=None,
            searched_scene_count=1,
            adoption="",
        )
        about.adoption = "WAITING" if given["allow_adoption"] else ""
        if self.plant is not None:
            return Rejected(**({"diagnostics": about} | self.plant))
        time_s = capture_time.timestamp() - at(0) / 1e9
        pose = MAP_FROM_ODOM.compose(drive(time_s)).compose(BASE_FROM_CAMERA)
        return SimpleNamespace(
            world_from_camera=pose,
            scene=self.scene,
            covariance=COVARIANCE,
            diagnostics=about,
            prior_checks=(),
            arbitrary_unit=False,
            accuracy=None,
            trust=0.5,
            inlier_count=9,
            match_count=10,
        )


def lookup(target: str, source: str, stamp_ns: int) -> RigidTransform:
    """tf: the drive as odometry for ten seconds, and the camera on the base."""
    time_s = (stamp_ns - at(0)) / 1e9
    if (target, source) == ("base_link", "camera"):
        return BASE_FROM_CAMERA
    if (target, source) == ("odom", "base_link") and 0 <= time_s <= 10:
        return drive(time_s)
    raise LookupError(f"no {target} > {source} at {time_s:g} s")


def shot(time_s: float, frame: str = "/camera") -> Any:
    return image(at(time_s), textured(), "rgb8", frame)


@pytest.fixture
def client() -> PlantedClient:
    return PlantedClient()


def make(client: Any, **options: Any) -> Localizer:
    return Localizer(client, LocalizerOptions("hall", **options), lookup)


def test_map_to_odom_is_the_planted_one(client: PlantedClient) -> None:
    outcome = make(client).localize(shot(2.0), RosCamera(CAMERA))
    assert (outcome.level, outcome.message, outcome.frame, outcome.stamp_ns) == (
        "OK",
        "localized",
        "base_link",
        at(2.0),
    )
    assert outcome.map_from_body is not None
    assert outcome.covariance is not None
    assert outcome.tf_edge is not None
    np.testing.assert_allclose(outcome.map_from_body.matrix(), MAP_FROM_ODOM.compose(drive(2.0)).matrix(), atol=2e-6)
    assert outcome.tf_edge[0] == "odom"
    np.testing.assert_allclose(outcome.tf_edge[1].matrix(), MAP_FROM_ODOM.matrix(), atol=5e-6)
    _, covariance = pose_of_body(
        MAP_FROM_ODOM.compose(drive(2.0)).compose(BASE_FROM_CAMERA), COVARIANCE, BASE_FROM_CAMERA
    )
    np.testing.assert_allclose(outcome.covariance, covariance, rtol=1e-4, atol=1e-12)


def test_without_odometry_tf_gets_the_body(client: PlantedClient) -> None:
    outcome = make(client, odom_frame="").localize(shot(2.0), RosCamera(CAMERA))
    assert outcome.tf_edge is not None
    assert outcome.tf_edge[0] == "base_link"
    camera = make(client, odom_frame="", base_frame="").localize(shot(2.0), RosCamera(CAMERA))
    assert camera.tf_edge is not None
    assert camera.tf_edge[0] == "camera"
    late = make(client).localize(shot(11.0), RosCamera(CAMERA))
    assert (late.level, late.tf_edge) == ("OK", None)
    assert "tf does not know odom > base_link" in late.message


def test_null_odometry_is_as_odometry_that_is_unknown(client: PlantedClient) -> None:
    def lost(target: str, source: str, stamp_ns: int) -> RigidTransform:
        if target == "odom":
            raise ValueError("quaternion must have norm 1, has 0")
        return lookup(target, source, stamp_ns)

    localizer = Localizer(cast(Any, client), LocalizerOptions("hall"), lost)
    outcome = localizer.localize(shot(1.0), RosCamera(CAMERA))
    assert (outcome.level, outcome.tf_edge) == ("OK", None)
    assert "tf does not know odom > base_link" in outcome.message


def test_failures_are_outcomes(client: PlantedClient) -> None:
    localizer = make(client)
    client.plant = {"reason": "LOW_OVERLAP", "message": "3 of 20 matches"}
    rejected = localizer.localize(shot(1.0), RosCamera(CAMERA))
    assert (rejected.level, rejected.message) == ("WARN", "LOW_OVERLAP: 3 of 20 matches")
    assert rejected.values["reason"] == "LOW_OVERLAP"
    client.plant = Unavailable("UNAVAILABLE", "no server")
    assert localizer.localize(shot(1.0), RosCamera(CAMERA)).level == "ERROR"
    assert "tf: no base_link > other" in localizer.localize(shot(1.0, "other"), RosCamera(CAMERA)).message
    wrong = shot(1.0)
    wrong.encoding = "32FC1"
    assert "'32FC1' is none of" in localizer.localize(wrong, RosCamera(CAMERA)).message


def test_odometry_moves_an_initial_pose_until_localized(client: PlantedClient) -> None:
    localizer = make(client)
    given = MAP_FROM_ODOM.compose(drive(1.0))
    localizer.guess(pose_with_covariance(at(1.0), "/map", given, np.diag([0.25, 0.25, 0, 0, 0, 0.07])), 0)
    client.plant = {"reason": "LOW_OVERLAP", "message": "dark"}
    localizer.localize(shot(2.0), RosCamera(CAMERA))
    client.plant = None
    localizer.localize(shot(4.0), RosCamera(CAMERA))
    localizer.localize(shot(5.0), RosCamera(CAMERA))
    first, second, third = client.priors
    for prior, time_s in ((first, 2.0), (second, 4.0)):
        true = MAP_FROM_ODOM.compose(drive(time_s)).compose(BASE_FROM_CAMERA)
        np.testing.assert_allclose(prior.world_from_camera.matrix(), true.matrix(), atol=1e-6)
        assert (np.linalg.eigvalsh(prior.covariance) > 0).all()
    assert np.trace(second.covariance) > np.trace(first.covariance)
    assert first.covariance[2, 2] > 1.0  # what rviz does not state is not known
    assert third is None


def test_an_error_of_direction_grows_with_the_way(client: PlantedClient) -> None:
    """A guess that is 0.1 rad off about z: the camera that odometry moves on is off as far as the prior allows."""
    localizer = make(client)
    base = MAP_FROM_ODOM.compose(drive(0.0))
    turned = RigidTransform(rotation_from_vector([0, 0, 0.1]) @ base.rotation, base.translation)
    given = np.diag([1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 0.01])
    localizer.guess(pose_with_covariance(at(0.0), "map", turned, given), 0)
    localizer.localize(shot(8.0), RosCamera(CAMERA))
    (prior,) = client.priors
    true = MAP_FROM_ODOM.compose(drive(8.0)).compose(BASE_FROM_CAMERA)
    error_m = prior.world_from_camera.translation - true.translation
    assert np.linalg.norm(error_m) > 0.7
    sigmas = error_m[:2] @ np.linalg.solve(prior.covariance[:2, :2], error_m[:2])
    assert 0.1 < sigmas < 1.2
    along = error_m / np.linalg.norm(error_m)
    assert along @ prior.covariance[:3, :3] @ along > 0.9 * 0.8**2


def test_among_several_scenes_each_has_its_frame(client: PlantedClient) -> None:
    localizer = Localizer(
        cast(Any, client), LocalizerOptions(group={}, map_frame="map_{scene}", use_last_pose=True), lookup
    )
    first = localizer.localize(shot(1.0), RosCamera(CAMERA))
    client.scene = "scenes/yard"
    second = localizer.localize(shot(2.0), RosCamera(CAMERA))
    localizer.localize(shot(3.0), RosCamera(CAMERA))
    assert (first.map_frame, second.map_frame) == ("map_hall", "map_yard")
    assert [it[-1] for it in client.where] == ["", "scenes/hall", "scenes/yard"]
    assert {it[:-1] == ("", (), {}) for it in client.where} == {True}
    localizer.guess(pose_with_covariance(at(3.0), "map_attic", MAP_FROM_ODOM.compose(drive(3.0))), 0)
    client.plant = InvalidArgument("INVALID_ARGUMENT", "none of them", field="prior_scene")
    assert localizer.localize(shot(4.0), RosCamera(CAMERA)).level == "ERROR"
    client.plant = None
    assert localizer.localize(shot(5.0), RosCamera(CAMERA)).level == "OK"
    assert [it[-1] for it in client.where[3:]] == ["attic", ""]
    with pytest.raises(ValueError, match="given in frame 'map'"):
        localizer.guess(pose_with_covariance(at(1.0), "map", MAP_FROM_ODOM), 0)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"scene": "hall", "group": {}}, "only one of scene, scenes and group"),
        ({"scenes": ["hall", "yard"]}, "map_frame must have {scene}"),
        ({"group": {}, "map_frame": "{scene}"}, "map_frame must have {scene}"),
        ({"group": {}, "map_frame": "map_{scene}", "sequence_length": 3}, "sequence_length needs scene"),
    ],
)
def test_options_of_several_scenes_that_cannot_be_are_named(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        LocalizerOptions(**wrong)


def test_an_initial_pose_during_a_call_is_kept(client: PlantedClient) -> None:
    localizer, answered = make(client), client.localize

    def meanwhile(*positional: Any, **named: Any) -> Any:
        localizer.guess(pose_with_covariance(at(1.0), "map", MAP_FROM_ODOM.compose(drive(1.0))), 0)
        return answered(*positional, **named)

    client.localize = meanwhile  # type: ignore[method-assign]
    localizer.localize(shot(1.0), RosCamera(CAMERA))
    client.localize = answered  # type: ignore[method-assign]
    localizer.localize(shot(2.0), RosCamera(CAMERA))
    localizer.localize(shot(3.0), RosCamera(CAMERA))
    assert [it is None for it in client.priors] == [True, False, True]


def test_the_last_pose_is_a_prior_only_where_asked(client: PlantedClient) -> None:
    localizer = make(client, use_last_pose=True)
    localizer.localize(shot(1.0), RosCamera(CAMERA))
    localizer.localize(shot(3.0), RosCamera(CAMERA))
    assert client.priors[0] is None
    moved = client.priors[1].world_from_camera
    true = MAP_FROM_ODOM.compose(drive(3.0)).compose(BASE_FROM_CAMERA)
    assert np.linalg.norm(moved.translation - true.translation) < 1e-5
    assert rotation_angle_deg(moved.rotation @ true.rotation.T) < 1e-3


def test_a_guess_without_odometry_fades_and_ends(client: PlantedClient) -> None:
    localizer = make(client, odom_frame="", use_last_pose=True)
    for time_s in (0.0, 1.0, 7.0):
        localizer.localize(shot(time_s), RosCamera(CAMERA))
    none, faded, ended = client.priors
    assert none is None
    assert ended is None
    assert faded.covariance[0, 0] > 1.5**2


def test_an_initial_pose_that_is_none_is_named(client: PlantedClient) -> None:
    localizer = make(client)
    with pytest.raises(ValueError, match="frame 'odom', not in 'map'"):
        localizer.guess(pose_with_covariance(1, "odom", drive(0)), 0)
    with pytest.raises(ValueError, match="a variance below 0"):
        localizer.guess(pose_with_covariance(1, "map", drive(0), -np.eye(6)), 0)


def test_the_rate_bears_jitter_and_time_that_jumps_back(client: PlantedClient) -> None:
    localizer = make(client, rate_hz=2.0)
    times = [0.0, 0.1, 0.49, 0.6, 0.98, 0.2]
    due = []
    for time_s in times:
        due.append(localizer.is_due(at(time_s)))
        if due[-1]:
            localizer.localize(shot(time_s), RosCamera(CAMERA))
    assert due == [True, False, True, False, True, True]
    assert not make(client, rate_hz=0.0).is_due(at(0))


def test_a_rejected_image_is_localized_with_those_before(client: PlantedClient) -> None:
    """Only after one that is rejected alone, with the odometry of each camera, and not across a jump of time."""
    sent: list[list[SequenceFrame]] = []

    def localize_sequence(frames: list[SequenceFrame], scene: str, **_: Any) -> Any:
        sent.append(frames)
        poses = tuple(MAP_FROM_ODOM.compose(it.session_from_camera) for it in frames)
        about = SimpleNamespace(
            request_id="s",
            total_s=0.5,
            queue_s=0.0,
            references=(),
            depth_check=None,
            searched_scene_count=1,
            adoption="",
        )
        report = ImageReport(5, 9, "LOW_OVERLAP", about)  # type: ignore[arg-type]
        accuracy = Accuracy(0.01, 0.02, 0.1, 0.2, False)
        world_from_session = Similarity(1.0, np.eye(3), np.zeros(3))
        reports = (report,) * len(frames)
        return SequenceLocalization(world_from_session, 0.0, poses, COVARIANCE, accuracy, 9, 10, 0.5, reports, "OPENCV")

    client.localize_sequence = localize_sequence  # type: ignore[attr-defined]
    localizer = make(client, sequence_length=3)
    outcomes = []
    for number, rejected in enumerate([True, False, False, False, True]):
        client.plant = {"reason": "LOW_OVERLAP", "message": "dark"} if rejected else None
        outcomes.append(localizer.localize(shot(float(number)), RosCamera(CAMERA)))
    assert [it.level for it in outcomes] == ["WARN", "OK", "OK", "OK", "OK"]
    (frames,) = sent
    assert outcomes[-1].message == "localized by the last 3 images"
    assert (outcomes[-1].values["images"], outcomes[-1].values["position_95_m"]) == ("3", "0.0200")
    for frame, time_s in zip(frames, (2.0, 3.0, 4.0), strict=True):
        np.testing.assert_allclose(
            frame.session_from_camera.matrix(), drive(time_s).compose(BASE_FROM_CAMERA).matrix(), atol=1e-6
        )
    found = outcomes[-1].map_from_body
    assert found is not None
    np.testing.assert_allclose(found.matrix(), MAP_FROM_ODOM.compose(drive(4.0)).matrix(), atol=1e-6)
    assert localizer.localize(shot(1.0), RosCamera(CAMERA)).level == "WARN"
    assert len(sent) == 1


def test_each_image_has_the_shutter_of_the_options(client: PlantedClient) -> None:
    sent, answered = list[Any](), client.localize

    def noted(*positional: Any, **named: Any) -> Any:
        sent.append(named["intrinsics_uncertainty"])
        return answered(*positional, **named)

    client.localize = noted  # type: ignore[method-assign]
    make(client).localize(shot(1.0), RosCamera(CAMERA))
    shutter: dict[str, Any] = {"readout_s": 0.02, "readout_direction": "bottom_to_top"}
    shutter |= {"speed_m_per_s": 1.5, "turn_deg_per_s": 30.0}
    make(client, **shutter).localize(shot(1.0), RosCamera(CAMERA))
    assert sent == [None, IntrinsicsUncertainty(**shutter)]


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"readout_s": 33.0}, "readout_s must be 0 to 0.2 s, is 33"),
        ({"readout_s": 0.02, "readout_direction": "up"}, "readout_direction must be one of top_to_bottom, .*'up'"),
        ({"readout_s": 0.02, "speed_m_per_s": -1.0}, "speed_m_per_s must be 0 to 1000 m/s, is -1"),
        ({"readout_s": 0.02, "turn_deg_per_s": float("nan")}, "turn_deg_per_s must be 0 to 3600 degrees/s, is nan"),
        ({"turn_deg_per_s": 30.0}, "turn_deg_per_s is of a rolling shutter, and readout_s is 0"),
        ({"sequence_length": 1}, "sequence_length must be 0 or 2 to 16 images, is 1"),
        ({"sequence_length": 4, "odom_frame": ""}, "sequence_length needs odom_frame"),
        ({"map_frame": "odom"}, "map_frame"),
        ({"rate_hz": -1.0}, "rate"),
        ({"rate_hz": float("nan")}, "rate"),
        ({"timeout_s": 0.0}, "timeout"),
    ],
)
def test_options_that_cannot_be_are_named(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        LocalizerOptions("hall", **wrong)
    with pytest.raises(ValueError, match="scene is empty"):
        LocalizerOptions("")


@pytest.mark.parametrize("allowed", [False, True])
def test_images_may_be_kept_only_where_the_option_allows_it(client: PlantedClient, allowed: bool) -> None:
    options = LocalizerOptions("hall", allow_adoption=allowed)
    found = Localizer(cast(Any, client), options, lookup).localize(shot(1.0), RosCamera(CAMERA))
    assert found.values.get("adoption", "") == ("WAITING" if allowed else "")
    assert not LocalizerOptions("hall").allow_adoption
