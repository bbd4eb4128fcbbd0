"""Messages of Open AR Cloud's GeoPose Protocol, version 2, as far as they are used.

The protocol has no formal description; it is defined by github.com/OpenArCloud/oscp-geopose-protocol (README.md
and the Python library) and the schemas of gpp-access.
"""
# ruff: noqa: N815  members carry the names of the protocol

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Text = Annotated[str, Field(max_length=1000)]
Ignored = Any


class _Message(BaseModel):
    """A message; unknown members are ignored, since clients send some of their own."""

    model_config = ConfigDict(extra="ignore")


class Position(_Message):
    """Position of a GeoPose: WGS84, degrees, and metres above the ellipsoid."""

    lat: Annotated[Number, Field(ge=-90, le=90)]
    lon: Annotated[Number, Field(ge=-180, le=180)]
    h: Annotated[Number, Field(ge=-12_000, le=100_000)]


class Quaternion(_Message):
    """Rotation of a GeoPose, from x forward, y left, z up to east, north, up."""

    x: Number
    y: Number
    z: Number
    w: Number


class GeoPoseMessage(_Message):
    """OGC GeoPose 1.0, Basic-Quaternion."""

    position: Position
    quaternion: Quaternion


class Accuracy(_Message):
    """Radii that contain the error in 68 % of cases: metres and degrees."""

    position: Number
    orientation: Number


class Response(_Message):
    """An answer, also one that a later request contains as a prior."""

    id: Text
    timestamp: Number
    accuracy: Accuracy
    type: Text = "geopose"
    geopose: GeoPoseMessage


class CameraParameters(_Message):
    """COLMAP's model and its parameters; the centre of the top-left pixel is (0.5, 0.5)."""

    model: Text = "UNKNOWN"
    modelParams: Annotated[list[Number], Field(max_length=20)] = []


class Orientation(_Message):
    """How the device was held; not used, since the pose refers to the raster as it is sent."""

    mirrored: bool = False


class CameraReading(_Message):
    """A photograph."""

    timestamp: Number = 0.0
    sensorId: Text = ""
    privacy: Ignored = None
    imageFormat: Text = "JPG"
    size: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = None
    imageBytes: str
    imageOrientation: Orientation | None = None
    params: CameraParameters | None = None


class GeolocationReading(_Message):
    """A position of a receiver; `heading` and `speed` are ignored."""

    timestamp: Number = 0.0
    privacy: Ignored = None
    latitude: Annotated[Number, Field(ge=-90, le=90)]
    longitude: Annotated[Number, Field(ge=-180, le=180)]
    altitude: Number | None = None
    accuracy: Number | None = None
    altitudeAccuracy: Number | None = None


class SensorReadings(_Message):
    """The photograph and the position are used; readings of other sensors are accepted and ignored."""

    cameraReadings: Annotated[list[CameraReading], Field(max_length=100, fail_fast=True)] = []
    geolocationReadings: Annotated[list[GeolocationReading], Field(max_length=1000, fail_fast=True)] = []
    wiFiReadings: Ignored = None
    bluetoothReadings: Ignored = None
    accelerometerReadings: Ignored = None
    gyroscopeReadings: Ignored = None
    magnetometerReadings: Ignored = None


class Request(_Message):
    """One photograph, and what is known about where it was taken."""

    id: Text
    timestamp: Number
    type: Literal["geopose"] = "geopose"
    sensors: Ignored = None
    sensorReadings: SensorReadings
    priorPoses: Annotated[list[Response], Field(max_length=1000, fail_fast=True)] = []
