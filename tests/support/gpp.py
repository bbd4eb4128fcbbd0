"""Messages of the GeoPose Protocol as its own clients send them, built by hand."""

import base64
import time
import uuid
from typing import Any

import numpy as np

from support.servers import CAMERA, PHOTO

PRIVACY: dict[str, list[str]] = {
    "dataRetention": [],
    "dataAcceptableUse": [],
    "dataSanitizationApplied": [],
    "dataSanitizationRequested": [],
}
PARAMETERS = [CAMERA.focal_x_px, CAMERA.focal_y_px, CAMERA.principal_x_px + 0.5, CAMERA.principal_y_px + 0.5]
CAMERA_ID, POSITION_ID = "0", "1"


def camera_reading(**changes: Any) -> dict[str, Any]:
    """As gpp-access sends it."""
    return {
        "timestamp": 1000 * time.time(),
        "sensorId": CAMERA_ID,
        "privacy": PRIVACY,
        "sequenceNumber": 0,
        "imageFormat": "JPG",
        "size": [CAMERA.width_px, CAMERA.height_px],
        "imageBytes": base64.b64encode(PHOTO).decode(),
        "imageOrientation": {"mirrored": False, "rotation": 0},
        "params": {"model": "PINHOLE", "modelParams": PARAMETERS, "minMaxDepth": [], "minMaxDisparity": []},
    } | changes


def request(*readings: dict[str, Any], **sensor_readings: Any) -> dict[str, Any]:
    """A request with these camera readings, by default one."""
    return {
        "id": str(uuid.uuid4()),
        "timestamp": 1000 * time.time(),
        "type": "geopose",
        "sensors": [{"id": CAMERA_ID, "type": "camera"}, {"id": POSITION_ID, "type": "geolocation"}],
        "sensorReadings": {"cameraReadings": list(readings or [camera_reading()])} | sensor_readings,
    }


def geolocation(lat: float, lon: float, **changes: Any) -> dict[str, Any]:
    """A reading of a receiver."""
    return {
        "timestamp": 1000 * time.time(),
        "sensorId": POSITION_ID,
        "privacy": PRIVACY,
        "latitude": lat,
        "longitude": lon,
        "altitude": 0,
        "accuracy": 8.0,
        "altitudeAccuracy": 0,
        "heading": 0,
        "speed": 0,
    } | changes


def demo_request() -> dict[str, Any]:
    """As the official demo client sends it, which leaves out `privacy` and `size`; with intrinsics, which it lacks."""
    reading = camera_reading()
    del reading["privacy"], reading["size"]
    position = {"timestamp": 1000 * time.time(), "sensorId": "1", "latitude": 47.0, "longitude": 8.0, "altitude": 0}
    return request(reading, geolocationReadings=[position])


def raw_pixels(channels: int) -> bytes:
    """A gradient of the camera's size: RGBA32 or GRAY8."""
    values = np.arange(CAMERA.width_px * CAMERA.height_px * channels) % 251
    return values.astype(np.uint8).tobytes()
