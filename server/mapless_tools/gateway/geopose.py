"""The GeoPose Protocol: converts a request to a photograph with priors, and an answer to a response.

Values that clients omit or set to zero are taken as unknown.
"""

import base64
import binascii
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pydantic import ValidationError

from mapless import Camera, Datum, GeoPositionPrior, LocalizationResult, PosePrior, Priors
from mapless.geodesy import GeoPose, pose_from_geopose
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits
from mapless_server.images.decode import image_size
from mapless_tools.ingest.formats.colmap.cameras import PARAMETERS, ColmapCamera

from .guard import Failure, checked_json
from .messages import CameraParameters, CameraReading, GeolocationReading, Request, Response

MEDIA_TYPE = "application/vnd.oscp+json;version=2.0"
CAMERA = "sensorReadings.cameraReadings"
_FUTURE_S = 300.0
"""Clocks of devices differ from ours by less."""
_WALK_M_PER_S = 2.0
_TURN_DEG_PER_S = 90.0
"""How fast a prior loses its worth: a person walks and looks around."""
_OLD_S = 60.0
"""Older priors say nothing that a photograph does not."""
_UNKNOWN_SIGMA_M = 50.0
"""Standard deviation of a position without an accuracy: that of a receiver among houses."""
_SIGMAS_OF_68 = 1.5
"""A 68 % radius in the plane, in standard deviations."""
_MAX_SIGMA_M = 1e4
_HEIGHTS_M = (-12_000, 100_000)
"""Range of heights of the interface's positions."""
_UNKNOWN_MODEL = "UNKNOWN"


@dataclass(frozen=True, eq=False)
class Photograph:
    """The contents of a request; its id and time are for the response.

    The camera is None where the request has none: the server then chooses it. `prior_fields` has the path of each prior
    in the request, by the field of the call. If confidential, the photograph is used for the answer only.
    """

    request_id: str
    timestamp_ms: float
    image: bytes
    camera: Camera | None
    priors: Priors
    prior_fields: dict[str, str]
    is_confidential: bool


def check_version(accept: str) -> None:
    """Rejects a client that accepts only another version of the protocol."""
    for part in accept.replace(" ", "").lower().split(","):
        kind, _, parameters = part.partition(";")
        if kind == "application/vnd.oscp+json":
            version = dict(it.split("=", 1) for it in parameters.split(";") if "=" in it).get("version", "2.0")
            if version.split(".")[0] != "2":
                raise Failure(
                    f"version {version[:20]} of the protocol is not served, 2.0 is",
                    406,
                    reason="VERSION",
                    field="accept",
                )


def read(body: bytes, datum: Datum | None) -> Photograph:
    """Reads the photograph of a body, for a scene with this datum or any; Failure names what is wrong, and where."""
    return photograph_of(read_request(body), datum)


def read_request(body: bytes) -> Request:
    """Reads the request of a body; Failure names what is wrong, and where."""
    body = bytes(checked_json(body))
    try:
        return Request.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = _path(first["loc"])
        if where == "sensorReadings" and first["type"] == "model_type" and b'"cameraReadings"' not in body:
            raise Failure("must be an object: version 1 of the protocol is not served, 2.0 is", field=where) from None
        raise Failure(f"{where or 'the body'}: {first['msg']}", field=where) from None


def photograph_of(request: Request, datum: Datum | None, now_s: float | None = None) -> Photograph:
    """Converts a request for a scene with this datum, or for any of several scenes; Failure names what is wrong.

    A pose prior is given in the world of a scene: without one, an earlier pose is a prior of the position alone.
    """
    readings, now_ms = request.sensorReadings, 1000 * (time.time() if now_s is None else now_s)
    _check_past(request.timestamp, now_ms, "timestamp")
    cameras = [(i, it) for i, it in enumerate(readings.cameraReadings) if it.imageFormat.upper() != "DEPTH"]
    if len(cameras) != 1:
        raise Failure(f"one photograph is localized at a time, the request has {len(cameras)}", field=CAMERA)
    ((i, reading),) = cameras
    where = f"{CAMERA}[{i}]"
    _check_past(reading.timestamp, now_ms, f"{where}.timestamp")
    taken_ms = reading.timestamp or request.timestamp
    image, (width_px, height_px) = _image_of(reading, where)
    camera = _camera_of(reading.params, width_px, height_px, f"{where}.params")
    geo, geo_field = _position_prior(readings.geolocationReadings, taken_ms, now_ms)
    earlier = _earlier_pose(request.priorPoses, taken_ms, now_ms)
    pose, pose_field = (None, "") if earlier is None or datum is None else (earlier.prior(datum), earlier.field)
    if earlier is not None and datum is None and (geo is None or earlier.sigma_m < geo.horizontal_sigma_m):
        geo, geo_field = earlier.position_prior(), earlier.field
    return Photograph(
        request.id,
        taken_ms,
        image,
        camera,
        Priors(geo_position=geo, pose=pose),
        {
            "image": f"{where}.imageBytes",
            "intrinsics": f"{where}.params",
            "geo_position_prior": geo_field,
            "pose_prior": pose_field,
        },
        # The protocol has no words for its policies, so none of them is read as leave to keep a photograph.
        any(it is not None for it in (reading.privacy, *(geo.privacy for geo in readings.geolocationReadings))),
    )


def response_to(photograph: Photograph, answer: LocalizationResult) -> dict[str, Any]:
    """Makes the protocol's response; Failure for an answer without a position on the Earth."""
    if answer.geo_pose is None or answer.accuracy is None:
        raise Failure("the answer has no place on the Earth", 502, reason="MALFORMED_ANSWER")
    return {
        "id": photograph.request_id,
        "timestamp": photograph.timestamp_ms,
        "accuracy": {"position": answer.accuracy.position_68_m, "orientation": answer.accuracy.rotation_68_deg},
        "type": "geopose",
        "geopose": answer.geo_pose.to_json(),
    }


def _image_of(reading: CameraReading, where: str) -> tuple[bytes, tuple[int, int]]:
    text = reading.imageBytes
    if text.startswith("data:"):
        text = text.partition(",")[2]
    try:
        image = base64.b64decode(text.encode("ascii"), validate=True)
    except (binascii.Error, UnicodeEncodeError) as error:
        raise Failure(f"is not base64: {error}", field=f"{where}.imageBytes") from None
    if reading.imageOrientation is not None and reading.imageOrientation.mirrored:
        raise Failure("a mirrored photograph cannot be localized", field=f"{where}.imageOrientation.mirrored")
    size = None if reading.size is None or not any(reading.size) else tuple(reading.size)
    if size is not None and any(it < 1 or it % 1 for it in size):
        raise Failure("must be two positive whole numbers: width and height, pixels", field=f"{where}.size")
    channels = {"RGBA32": 4, "GRAY8": 1}.get(reading.imageFormat.upper())
    if channels is not None and size is not None and len(image) == size[0] * size[1] * channels:
        image = _encoded(image, int(size[0]), int(size[1]), channels)
    try:
        width_px, height_px = image_size(image, ImageLimits())
    except InvalidArgument as error:
        raise Failure(str(error), reason=error.reason, field=f"{where}.imageBytes") from None
    if size not in (None, (width_px, height_px)):
        given = "x".join(f"{it:g}" for it in size or ())
        raise Failure(f"the image is {width_px}x{height_px} pixels, not {given}", field=f"{where}.size")
    return image, (width_px, height_px)


def _encoded(pixels: bytes, width_px: int, height_px: int, channels: int) -> bytes:
    """Encodes pixels as a PNG; a too small image is returned unchanged."""
    if not pixels:
        return pixels
    raster = np.frombuffer(pixels, np.uint8).reshape(height_px, width_px, channels)
    bgr = cv2.cvtColor(raster, cv2.COLOR_RGBA2BGR) if channels == 4 else raster
    _, png = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return png.tobytes()


def _camera_of(given: CameraParameters | None, width_px: int, height_px: int, where: str) -> Camera | None:
    """Makes the camera of the parameters; None without them."""
    model = given.model.upper() if given is not None else _UNKNOWN_MODEL
    if given is None or (model.startswith(_UNKNOWN_MODEL) and not given.modelParams):
        return None
    if model not in PARAMETERS:
        raise Failure(f"is none of COLMAP's models: {given.model[:40]!a}", field=f"{where}.model")
    names = PARAMETERS[model]
    if len(given.modelParams) != len(names):
        raise Failure(
            f"{model} has {len(names)} parameters ({', '.join(names)}), given are {len(given.modelParams)}",
            field=f"{where}.modelParams",
        )
    try:
        return ColmapCamera(1, model, width_px, height_px, given.modelParams).camera()
    except ValueError as error:
        raise Failure(str(error), field=where) from None


def _position_prior(
    readings: Sequence[GeolocationReading], taken_ms: float, now_ms: float
) -> tuple[GeoPositionPrior | None, str]:
    """The prior of the reading nearest to the photograph in time, with its field; a reading without age is skipped."""
    found: list[tuple[float, int]] = []
    for i, reading in enumerate(readings):
        _check_past(reading.timestamp, now_ms, f"sensorReadings.geolocationReadings[{i}].timestamp")
        age_s = abs(taken_ms - reading.timestamp) / 1000 if reading.timestamp else 0.0
        if age_s <= _OLD_S:
            found.append((age_s, i))
    if not found:
        return None, ""
    age_s, i = min(found)
    reading = readings[i]
    accuracy_m = reading.accuracy or 0.0
    sigma_m = accuracy_m / _SIGMAS_OF_68 if accuracy_m > 0 else _UNKNOWN_SIGMA_M
    sigma_m = min(max(math.hypot(sigma_m, _WALK_M_PER_S * age_s), 0.1), _MAX_SIGMA_M)
    height_m, vertical_sigma_m = reading.altitude, reading.altitudeAccuracy or 0.0
    # Many devices give a height of 0, or one above the sea, and no accuracy of it.
    if vertical_sigma_m <= 0 or height_m is None or not _HEIGHTS_M[0] <= height_m <= _HEIGHTS_M[1]:
        height_m, vertical_sigma_m = None, 0.0
    else:
        vertical_sigma_m = min(max(vertical_sigma_m, 0.1), _MAX_SIGMA_M)
    prior = GeoPositionPrior(reading.latitude, reading.longitude, sigma_m, height_m, vertical_sigma_m)
    return prior, f"sensorReadings.geolocationReadings[{i}]"


@dataclass(frozen=True, eq=False)
class _EarlierPose:
    """The pose of an earlier response, with the standard deviations that it has by now, and its path in the request."""

    pose: GeoPose
    sigma_m: float
    sigma_deg: float
    field: str

    def prior(self, datum: Datum) -> PosePrior:
        """The prior in the world of a scene with this datum."""
        return PosePrior.from_sigmas(pose_from_geopose(self.pose, datum), self.sigma_m, self.sigma_deg)

    def position_prior(self) -> GeoPositionPrior:
        """The prior of the position, in any scene with a datum."""
        return GeoPositionPrior(self.pose.lat, self.pose.lon, self.sigma_m, self.pose.h, self.sigma_m)


def _earlier_pose(earlier: Sequence[Response], taken_ms: float, now_ms: float) -> _EarlierPose | None:
    """The newest earlier response, less certain for each second that has passed; None if it says nothing any more."""
    for i, it in enumerate(earlier):
        _check_past(it.timestamp, now_ms, f"priorPoses[{i}].timestamp")
    if not earlier:
        return None
    i = max(range(len(earlier)), key=lambda i: earlier[i].timestamp)
    newest, where = earlier[i], f"priorPoses[{i}]"
    age_s = abs(taken_ms - newest.timestamp) / 1000
    accuracy = newest.accuracy
    if age_s > _OLD_S or not (0 <= accuracy.position <= _MAX_SIGMA_M and 0 <= accuracy.orientation <= 180):
        return None
    try:
        pose = GeoPose.from_json(newest.geopose.model_dump())
    except ValueError as error:
        raise Failure(str(error), field=f"{where}.geopose") from None
    sigma_m = max(math.hypot(accuracy.position, _WALK_M_PER_S * age_s), 0.01)
    sigma_deg = min(max(math.hypot(accuracy.orientation, _TURN_DEG_PER_S * age_s), 0.1), 180.0)
    return _EarlierPose(pose, sigma_m, sigma_deg, where)


def _check_past(timestamp_ms: float, now_ms: float, field: str) -> None:
    ahead_s = (timestamp_ms - now_ms) / 1000
    if ahead_s > _FUTURE_S:
        raise Failure(
            f"is {ahead_s:.6g} s ahead of the gateway's clock; milliseconds since 1970 are expected", field=field
        )


def _path(parts: Sequence[int | str]) -> str:
    """Joins a path: ("a", 0, "b") is "a[0].b"."""
    return "".join(f"[{it}]" if isinstance(it, int) else f".{it}" for it in parts).lstrip(".")
