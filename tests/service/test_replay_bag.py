"""`mapless-server replay-bag`: what it writes is read by Foxglove's own libraries, `mcap` and `mcap_ros2`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.json_format import MessageToJson
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from support.bags import (
    BASE_FROM_CAMERA,
    Recorded,
    at,
    compressed,
    drive,
    info,
    odometry,
    recorded_drive,
    write_bag,
)
from support.images import textured
from support.servers import CAMERA, PHOTO, RunningServer, make_scene, pose, serving
from typer.testing import CliRunner

from mapless import Client
from mapless.ros import transform_from_message, transform_from_pose
from mapless.wire import camera_to_message
from mapless_tools.cli.app import app

COUNT = 6


@pytest.fixture
def server(tmp_path: Path) -> Iterator[RunningServer]:
    with serving(tmp_path / "data") as running:
        with Client(running.address) as client:
            make_scene(client, "hall", 2)
        yield running


def recorded(file: bytes = PHOTO) -> list[Recorded]:
    """Six images in three seconds, the camera at rest on a base that drives, and an odometry of it."""
    pictures = [it for it in recorded_drive(CAMERA, [textured()] * COUNT, period_s=0.5) if "image" not in it[0]]
    times_ns = [at(0.5 * number) for number in range(COUNT)]
    return [*pictures, *(("/front/compressed", it, compressed(it, file)) for it in times_ns)]


def run(server: RunningServer, *arguments: object) -> tuple[int, str]:
    command = ["replay-bag", *map(str, arguments), "--address", server.address]
    result = CliRunner().invoke(app, command)
    return result.exit_code, result.output


def written(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """Time and message by topic, of the only file in a folder, with the schemas that the file itself has."""
    (file,) = folder.glob("*.mcap")
    found: dict[str, list[tuple[int, Any]]] = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
    return found


def test_poses_transforms_and_diagnostics_are_written(server: RunningServer, tmp_path: Path) -> None:
    bag, out = write_bag(tmp_path / "drive", recorded()), tmp_path / "out"
    code, output = run(server, bag, "hall", out, "--rate", 0)
    assert code == 0, output
    assert f"{COUNT} of {COUNT} localized (of {COUNT} images in the recording)" in output
    found = written(out)
    assert sorted(found) == ["/diagnostics", "/tf", "/tf_static", "/visual_localization/pose"]
    map_from_base = pose(0).compose(BASE_FROM_CAMERA.inverse())  # what that server answers
    poses, tfs = found["/visual_localization/pose"], found["/tf"]
    assert [time_ns for time_ns, _ in poses] == [at(0.5 * number) for number in range(COUNT)]
    for number, ((_, message), (_, tf)) in enumerate(zip(poses, tfs, strict=True)):
        np.testing.assert_allclose(transform_from_pose(message.pose.pose).matrix(), map_from_base.matrix(), atol=1e-9)
        assert np.linalg.eigvalsh(np.reshape(message.pose.covariance, (6, 6))).min() > 0
        first, second = tf.transforms
        names = [(it.header.frame_id, it.child_frame_id) for it in (first, second)]
        assert names == [("map", "odom"), ("odom", "base_link")]
        chained = transform_from_message(first.transform).compose(transform_from_message(second.transform))
        np.testing.assert_allclose(chained.matrix(), map_from_base.matrix(), atol=1e-9)
        odom_from_base = transform_from_message(second.transform)
        np.testing.assert_allclose(odom_from_base.matrix(), drive(0.5 * number).matrix(), atol=1e-8)
    assert {it.status[0].level for _, it in found["/diagnostics"]} == {0}
    (edge, _) = found["/tf_static"][0][1].transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("base_link", "mount")


def test_rejections_are_diagnostics_with_their_reason(server: RunningServer, tmp_path: Path) -> None:
    blank = recorded()
    blank[-1][2].data = np.frombuffer(b"\xff\xd8 no picture", np.uint8)
    out = tmp_path / "out"
    code, output = run(server, write_bag(tmp_path / "drive", blank), "hall", out)
    assert code == 0, output
    assert "3 of 3 localized (of 6" in output  # one a second: the last is not asked for
    code, output = run(server, tmp_path / "drive", "hall", tmp_path / "all", "--rate", 0)
    assert "5 of 6 localized; 1 " in output
    status = written(tmp_path / "all")["/diagnostics"][-1][1].status[0]
    assert status.level == 2
    assert status.hardware_id == "hall"
    assert "IMAGE" in status.message


def test_poses_in_the_map_are_compared(server: RunningServer, tmp_path: Path) -> None:
    map_from_base = pose(0).shifted([0.03, 0, 0]).compose(BASE_FROM_CAMERA.inverse())
    still = [("/odom", at(it), odometry(at(it), map_from_base, "map")) for it in (-1, 4)]
    bag = write_bag(tmp_path / "drive", [*(it for it in recorded() if it[0] != "/odom"), *still])
    code, output = run(server, bag, "hall", tmp_path / "out", "--max-pose-gap", 10)
    assert code == 0, output
    assert "median distance from the recording's own poses 3.00 cm, 0.000 degrees" in output
    (edge,) = written(tmp_path / "out")["/tf"][0][1].transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "base_link")


def test_a_recording_of_images_alone_gives_poses_of_the_camera(server: RunningServer, tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "drive", [it for it in recorded() if it[0] == "/front/compressed"])
    code, output = run(server, bag, "hall", tmp_path / "o")
    assert "has no CameraInfo for the images of /front/compressed; give --camera" in output
    assert (code, (tmp_path / "o").exists()) == (2, False)
    camera = tmp_path / "camera.json"
    camera.write_text(MessageToJson(camera_to_message(CAMERA), preserving_proto_field_name=True))
    code, output = run(server, bag, "hall", tmp_path / "o", "--camera", camera)
    assert code == 0, output
    message = written(tmp_path / "o")["/visual_localization/pose"][0][1]
    np.testing.assert_allclose(transform_from_pose(message.pose.pose).matrix(), pose(0).matrix(), atol=1e-9)
    assert written(tmp_path / "o")["/tf"][0][1].transforms[0].child_frame_id == "camera"


def test_what_cannot_be_replayed_writes_nothing(server: RunningServer, tmp_path: Path) -> None:
    bag, out = write_bag(tmp_path / "drive", recorded()), tmp_path / "out"
    code, output = run(server, bag, "cellar", out)
    assert (code, out.exists()) == (1, False)
    assert "cellar" in output
    assert run(server, tmp_path / "absent", "hall", out)[0] == 2
    out.mkdir()
    assert "exists already" in run(server, bag, "hall", out)[1]
    assert (
        "map_frame must differ" in run(server, bag, "hall", tmp_path / "o", "--map-frame", "x", "--odom-frame", "x")[1]
    )


def test_a_replay_that_ends_early_is_whole(server: RunningServer, tmp_path: Path) -> None:
    """Time jumps back after four images; and a server that stops."""
    messages = recorded()
    messages[-2][2].header.stamp.sec -= 60
    code, output = run(server, write_bag(tmp_path / "jump", messages), "hall", tmp_path / "out", "--rate", 0)
    assert code == 1
    assert "4 of 4 localized" in output
    assert "ended early" in output
    assert "time jumps back by 59.5" in output
    assert len(written(tmp_path / "out")["/visual_localization/pose"]) == 4
    wrong = [(t, n, info(CAMERA, binning_x=2) if t.endswith("info") else it) for t, n, it in recorded()]
    assert "is binned" in run(server, write_bag(tmp_path / "binned", wrong), "hall", tmp_path / "b")[1]
