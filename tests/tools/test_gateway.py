"""The gateway's GeoPose Protocol: poses, priors, and what it refuses."""

import base64
import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from support import gpp
from support.asgi import requested
from support.gateway_app import DATUM, INTRINSICS, behind_the_gateway, gateway_of
from support.servers import CAMERA, PHOTO, RunningServer, pose

from mapless import Client, LocalizationResult, aio
from mapless.calls import localization
from mapless.geodesy import geopose as geopose_of


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with behind_the_gateway(tmp_path_factory.mktemp("server")) as running:
        yield running


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The parameters of each call of Localize that the gateway makes."""
    calls: list[dict[str, Any]] = []

    async def localize(self: aio.Client, *given: Any, **named: Any) -> Any:
        calls.append(named | {"image": given[0], "camera": given[1], "scene": given[2]})
        return await localization.localize(self, *given, **named)

    monkeypatch.setattr(aio.Client, "localize", localize)
    return calls


async def test_a_request_of_the_protocol_is_answered_with_the_pose(server: RunningServer) -> None:
    request = gpp.request()
    async with gateway_of(server.address) as gateway:
        answer = await gateway.geopose(request)
    assert answer.status == 200, answer.body
    assert answer.headers["content-type"].startswith("application/vnd.oscp+json")
    response = answer.json
    assert set(response) == {"id", "timestamp", "accuracy", "type", "geopose"}
    assert (response["id"], response["type"]) == (request["id"], "geopose")
    assert response["timestamp"] == request["sensorReadings"]["cameraReadings"][0]["timestamp"]
    expected = geopose_of(pose(0.0), DATUM).to_json()
    for part in ("position", "quaternion"):
        assert response["geopose"][part] == pytest.approx(expected[part], abs=1e-9)
    with Client(server.address) as client:
        localized = client.localize(PHOTO, CAMERA, "hall")
    assert isinstance(localized, LocalizationResult)
    radii = localized.accuracy
    assert radii is not None
    assert response["accuracy"] == {"position": radii.position_68_m, "orientation": radii.rotation_68_deg}


async def test_the_official_demo_request_is_answered(server: RunningServer) -> None:
    async with gateway_of(server.address, scene="") as gateway:
        answer = await gateway.geopose(gpp.demo_request(), "/scenes/hall/geopose", accept="*/*")
        status = await gateway.get("/scenes/hall/geopose")
    assert answer.status == 200, answer.body
    assert (status.status, status.json) == (200, {"status": "running"})


async def test_the_protocols_own_library_reads_what_it_asked(server: RunningServer) -> None:
    library = pytest.importorskip(
        "oscp.geoposeprotocol", reason="needs python/ of OpenArCloud/oscp-geopose-protocol on PYTHONPATH"
    )
    reading = gpp.camera_reading()
    own = library.CameraReading(sensorId="0", timestamp=reading["timestamp"], sequenceNumber=1)
    own.imageFormat, own.size, own.imageBytes = library.ImageFormat.RGBA32, reading["size"], reading["imageBytes"]
    own.params = library.CameraParameters(library.CameraModel.PINHOLE, gpp.PARAMETERS)
    place = library.GeolocationReading(sensorId="1", latitude=47.0, longitude=8.0)
    request = library.GeoPoseRequest(timestamp=reading["timestamp"])
    request.sensors = [
        library.Sensor(library.SensorType.CAMERA, "0"),
        library.Sensor(library.SensorType.GEOLOCATION, "1"),
    ]
    request.sensorReadings.cameraReadings.append(own)
    request.sensorReadings.geolocationReadings.append(place)
    async with gateway_of(server.address) as gateway:
        first = await gateway.geopose(request.toJson().encode())
        response = library.GeoPoseResponse.fromJson(first.json)
        request.priorPoses = [response]
        second = await gateway.geopose(request.toJson().encode())
    assert response.geopose.position.lat == pytest.approx(geopose_of(pose(0.0), DATUM).lat)
    assert 0 < response.accuracy.position < 1
    assert second.json["geopose"] == first.json["geopose"]


@pytest.mark.parametrize(("name", "channels"), [("RGBA32", 4), ("GRAY8", 1)])
async def test_raw_pixels_arrive_as_they_were(
    server: RunningServer, asked: list[dict[str, Any]], name: str, channels: int
) -> None:
    pixels = gpp.raw_pixels(channels)
    async with gateway_of(server.address) as gateway:
        reading = gpp.camera_reading(imageFormat=name, imageBytes=base64.b64encode(pixels).decode())
        assert (await gateway.geopose(gpp.request(reading))).status == 200
    seen = np.frombuffer(pixels, np.uint8).reshape(CAMERA.height_px, CAMERA.width_px, channels)
    from mapless_server.images import ImageLimits, decode_image

    assert (decode_image(asked[0]["image"], ImageLimits()) == seen[..., :3]).all()


async def test_without_intrinsics_the_server_chooses_them(server: RunningServer, asked: list[dict[str, Any]]) -> None:
    """As the official demo client asks, which leaves out `params`."""
    request = gpp.demo_request()
    del request["sensorReadings"]["cameraReadings"][0]["params"]
    async with gateway_of(server.address) as gateway:
        assert (await gateway.geopose(request)).status == 200
    assert asked[0]["camera"] is None


async def test_positions_and_earlier_responses_become_priors(
    server: RunningServer, asked: list[dict[str, Any]]
) -> None:
    now_ms = 1000 * time.time()
    async with gateway_of(server.address) as gateway:
        first = (await gateway.geopose(gpp.request())).json
        old = first | {"timestamp": now_ms - 3_600_000}
        earlier = first | {"timestamp": now_ms - 2000}
        request = gpp.request(
            gpp.camera_reading(timestamp=now_ms),
            geolocationReadings=[gpp.geolocation(47.0, 8.0, timestamp=now_ms), gpp.geolocation(1, 1, timestamp=5.0)],
            wiFiReadings=[{"SSID": "x"}, 3],
            accelerometerReadings="anything",
        ) | {"priorPoses": [old, earlier]}
        answer = await gateway.geopose(request)
    assert answer.status == 200, answer.body
    priors = asked[-1]["priors"]
    assert (priors.geo_position.latitude_deg, priors.geo_position.height_m) == (47.0, None)
    assert priors.geo_position.horizontal_sigma_m == pytest.approx(8.0 / 1.5)
    assert np.allclose(priors.pose.world_from_camera.matrix(), pose(0.0).matrix(), atol=1e-6)
    sigma_m = np.sqrt(priors.pose.covariance[0, 0])
    assert sigma_m == pytest.approx(np.hypot(first["accuracy"]["position"], 4.0), rel=1e-3)


def reading_with(**changes: Any) -> dict[str, Any]:
    return gpp.request(gpp.camera_reading(**changes))


FUTURE_MS = 1000 * time.time() + 86_400_000
CAMERA_FIELD = "sensorReadings.cameraReadings[0]"
BAD: dict[str, tuple[Any, str, str]] = {
    "not JSON": (b"{", "", "EOF"),
    "not UTF-8": (b'{"id": "\xff"}', "", "invalid"),
    "a list": (b"[1]", "", "object"),
    "nothing": (b"", "", "EOF"),
    "a million values": (b"[" + b"[]," * 50_001 + b"[]]", "", "100000"),
    "no camera": ({**gpp.request(), "sensorReadings": {}}, "sensorReadings.cameraReadings", "has 0"),
    "two cameras": (gpp.request(gpp.camera_reading(), gpp.camera_reading()), "cameraReadings", "has 2"),
    "version 1": ({**gpp.request(), "sensorReadings": [{"sensorId": "0"}]}, "sensorReadings", "version 1"),
    "base64 garbage": (reading_with(imageBytes="@@@"), f"{CAMERA_FIELD}.imageBytes", "base64"),
    "base64 with letters": (reading_with(imageBytes="ééé"), f"{CAMERA_FIELD}.imageBytes", "base64"),
    "an empty image": (reading_with(imageBytes=""), f"{CAMERA_FIELD}.imageBytes", "empty"),
    "no image": (reading_with(imageBytes="aGFsbG8="), f"{CAMERA_FIELD}.imageBytes", "JPEG"),
    "a wrong size": (reading_with(size=[640, 480]), f"{CAMERA_FIELD}.size", "96x64 pixels, not 640x480"),
    "a negative size": (reading_with(size=[-96, -64]), f"{CAMERA_FIELD}.size", "positive"),
    "three sizes": (reading_with(size=[96, 64, 1]), f"{CAMERA_FIELD}.size", "2"),
    "another model": (reading_with(params={"model": "FOV", "modelParams": [1, 2, 3, 4, 5]}), "params", "FOV"),
    "too few parameters": (
        reading_with(params={"model": "PINHOLE", "modelParams": [80]}),
        f"{CAMERA_FIELD}.params.modelParams",
        "fx, fy, cx, cy",
    ),
    "a focal length of 0": (
        reading_with(params={"model": "PINHOLE", "modelParams": [0, 80, 48, 32]}),
        f"{CAMERA_FIELD}.params.focal_x_px",
        "focal_x_px",
    ),
    "a mirrored image": (reading_with(imageOrientation={"mirrored": True}), "imageOrientation.mirrored", "mirror"),
    "NaN": (json.dumps(reading_with(timestamp=float("nan"))).encode(), "timestamp", "number"),
    "a reading from the future": (reading_with(timestamp=FUTURE_MS), f"{CAMERA_FIELD}.timestamp", "ahead"),
    "a request from the future": ({**gpp.request(), "timestamp": FUTURE_MS}, "timestamp", "ahead"),
    "a position from the future": (
        gpp.request(geolocationReadings=[gpp.geolocation(47, 8, timestamp=FUTURE_MS)]),
        "sensorReadings.geolocationReadings[0].timestamp",
        "ahead",
    ),
    "a latitude of 91": (gpp.request(geolocationReadings=[gpp.geolocation(91, 8)]), "latitude", "90"),
    "a prior that is none": ({**gpp.request(), "priorPoses": [{"id": "x"}]}, "priorPoses[0]", "required"),
    "another type": ({**gpp.request(), "type": "ecef"}, "type", "geopose"),
    "too many cameras": (gpp.request(*[gpp.camera_reading(imageBytes="")] * 101), "cameraReadings", "100"),
}


@pytest.mark.parametrize("name", BAD)
async def test_bad_requests_are_answered_with_what_and_where(server: RunningServer, name: str) -> None:
    request, field, words = BAD[name]
    async with gateway_of(server.address) as gateway:
        answer = await gateway.geopose(request)
    error = answer.json["error"]
    assert answer.status == 400, error
    assert words in error["message"], error
    assert field in error.get("field", ""), error


async def test_scenes_and_versions_that_are_not_served(server: RunningServer) -> None:
    async with gateway_of(server.address, scene="") as gateway:
        answers = [
            await gateway.geopose(gpp.request(), "/scenes/nowhere/geopose"),
            await gateway.geopose(gpp.request(), "/scenes/absent/geopose"),
            await gateway.geopose(gpp.request(), "/scenes/a..b/geopose"),
            await gateway.geopose(
                gpp.request(), "/scenes/hall/geopose", accept="application/vnd.oscp+json; version=1.0;"
            ),
            await gateway.geopose(gpp.request(), "/nothing"),
            await requested(gateway.app, "PUT", "/geopose"),
        ]
    assert [it.status for it in answers] == [409, 404, 400, 406, 404, 405]
    assert [it.json["error"]["reason"] for it in answers][:2] == ["NO_DATUM", "NOT_FOUND"]


async def test_without_a_scene_it_is_found_among_those_on_the_earth(
    server: RunningServer, asked: list[dict[str, Any]]
) -> None:
    """An earlier answer is a prior of the position then: a pose prior is given in the world of one scene."""
    async with gateway_of(server.address, scene="") as gateway:
        first = await gateway.geopose(gpp.request())
        again = await gateway.geopose(gpp.request() | {"priorPoses": [first.json | {"timestamp": 1000 * time.time()}]})
    assert (first.status, first.headers["x-mapless-scene"]) == (200, "scenes/hall")
    assert [(it["group"], it["with_datum"]) for it in asked] == [({}, True)] * 2
    prior = asked[1]["priors"].geo_position
    assert (again.status, asked[1]["priors"].pose) == (200, None)
    assert prior.latitude_deg == first.json["geopose"]["position"]["lat"]
    assert prior.horizontal_sigma_m == pytest.approx(first.json["accuracy"]["position"], abs=10)


async def test_a_group_of_the_gateway_has_its_labels(server: RunningServer) -> None:
    async with gateway_of(server.address, scene="", group={"site": "x"}) as gateway:
        answers = [await gateway.geopose(gpp.request()), await gateway.form(image=PHOTO, intrinsics=INTRINSICS)]
        named = await gateway.form(image=PHOTO, intrinsics=INTRINSICS, request='{"scenes": ["scenes/nowhere"]}')
    assert [(it.status, it.json["error"]["field"]) for it in answers] == [(404, "scene_group")] * 2
    assert (named.status, named.json["scene"]) == (200, "scenes/nowhere")


async def test_a_rejection_says_why_and_what_helps(server: RunningServer) -> None:
    async with gateway_of(server.address, scene="empty") as gateway:
        answer = await gateway.geopose(gpp.request())
        plain = await gateway.form(image=PHOTO, intrinsics=INTRINSICS)
    error = answer.json["error"]
    assert (answer.status, error["reason"]) == (422, "NO_USABLE_REFERENCES")
    assert error["hint"]
    assert plain.status == 200
    assert plain.json["rejection"]["reason"] == "REJECTION_REASON_NO_USABLE_REFERENCES"
