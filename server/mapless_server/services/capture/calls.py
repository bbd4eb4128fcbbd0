"""The file of a captured call: all that decided the answer, except the references' photographs and features.

    first 32   SHA-256 of everything after
    header     one line of JSON; floats as the shortest decimal that reads back as the same float64
    request    the message
    response   the message

Photographs and features of references are blobs beside it, named by their SHA-256, since many calls share them.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

import numpy as np

from mapless.geometry import Camera, RigidTransform
from mapless.names import check_id
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.scenes import Choice, RankedReference
from mapless_server.security import check_tenant
from mapless_server.store import SceneAttributes, codec


class CaptureError(Exception):
    """The folder, or a call in it, cannot be used; the message is one sentence for the operator."""


class DamagedCapture(CaptureError):
    """A captured call is damaged: it was cut or changed, or a part of it is missing."""


class BlobDeleted(Exception):
    """A blob that the folder had when the call was collected has been deleted since."""


Request = pb.LocalizeRequest | pb.LocalizeRigRequest | pb.LocalizeSequenceRequest
Response = pb.LocalizeResponse | pb.LocalizeRigResponse | pb.LocalizeSequenceResponse


def diagnostics_of(response: Response) -> list[pb.Diagnostics]:
    """Returns the diagnostics of each photograph, in order."""
    if isinstance(response, pb.LocalizeResponse):
        return [response.diagnostics]
    return [image.diagnostics for image in response.images]


FORMAT_VERSION = 1
_DIGEST_BYTES = 32


@dataclass(frozen=True, eq=False)
class CapturedReference:
    """A reference that a photograph was compared with; its pose is metric, its camera in pixels of its photograph.

    Its id is unique within its scene; its key is never used again, so that a reference that replaces it has another.
    The blobs of the photograph and its mask, which may be empty for none, are named by their SHA-256, the blobs of its
    features by name of the extractor.
    """

    reference_id: str
    key: str
    camera: Camera
    world_from_camera: RigidTransform
    image_sha256: str
    views: Mapping[str, str]
    mask_sha256: str = ""

    @property
    def blobs(self) -> tuple[str, ...]:
        """Names of its blobs."""
        return (self.image_sha256, *self.views.values(), *filter(None, [self.mask_sha256]))


@dataclass(frozen=True, eq=False)
class CapturedPart:
    """The named or ranked references that one photograph of a call was compared with, at a generation of the scene.

    The field is the photograph's path in the request, "image" or "images[2].image". The choices are that of the answer
    and those by other descriptors; none if the caller named the references.
    """

    field: str
    generation: int
    references: tuple[CapturedReference, ...]
    choices: tuple[Choice, ...] = ()


@dataclass(frozen=True, eq=False)
class CapturedCall:
    """A call that was answered.

    Attributes:
        request_id: finds it in the log; callers may use one twice.
        time_s: when it was answered, Unix seconds.
        method: "Localize", "LocalizeRig" or "LocalizeSequence".
        tenant: tenant of the caller.
        scene_id: id of the scene within its tenant.
        scene_created_us: when the scene was created, Unix microseconds; distinguishes scenes of one name.
        circumstances: all else that decides an answer (versions, settings, weights), by name.
        attributes: attributes of the scene.
        parts: one for each photograph.
        request: the message as it was received.
        response: the message as it was sent.
    """

    request_id: str
    time_s: float
    method: str
    tenant: str
    scene_id: str
    scene_created_us: int
    circumstances: Mapping[str, str] = field(default_factory=dict)
    attributes: SceneAttributes = field(default_factory=SceneAttributes)
    parts: tuple[CapturedPart, ...] = ()
    request: bytes = b""
    response: bytes = b""

    @property
    def keys(self) -> frozenset[tuple[str, str]]:
        """Id and key of every reference."""
        return frozenset((it.reference_id, it.key) for part in self.parts for it in part.references)

    @property
    def blobs(self) -> frozenset[str]:
        """Names of the blobs that the call needs."""
        references = [it for part in self.parts for it in part.references]
        return frozenset(name for it in references for name in it.blobs)


def encode_call(call: CapturedCall) -> bytes:
    """Encodes a call as the content of its file."""
    header = {
        "format": FORMAT_VERSION,
        "request_id": call.request_id,
        "time_s": call.time_s,
        "method": call.method,
        "tenant": call.tenant,
        "scene_id": call.scene_id,
        "scene_created_us": call.scene_created_us,
        "circumstances": dict(call.circumstances),
        "attributes": json.loads(codec.encode_attributes(call.attributes) or b"null"),
        "parts": [_part_to_dict(part) for part in call.parts],
        "request_bytes": len(call.request),
    }
    body = b"".join([json.dumps(header, separators=(",", ":")).encode(), b"\n", call.request, call.response])
    return hashlib.sha256(body).digest() + body


def decode_call(data: bytes) -> CapturedCall:
    """Decodes the content of a call's file.

    All names, times and blobs are checked, since a digest shows damage, but not who wrote the file. DamagedCapture if
    the file is cut or changed; CaptureError if the file has the format of another version.
    """
    digest, body = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
    if hashlib.sha256(body).digest() != digest:
        raise DamagedCapture("it is cut or damaged, or no captured call")
    text, _, messages = body.partition(b"\n")
    try:
        header = json.loads(text)
        if header["format"] != FORMAT_VERSION:
            raise CaptureError(f"its format {header['format']} is another than this program's, {FORMAT_VERSION}")
        datetime.fromtimestamp(header["time_s"], timezone.utc)  # raises if it is no time: NaN would never expire
        check_id(header["scene_id"])
        check_tenant(header["tenant"])
        names = ("request_id", "time_s", "method", "tenant", "scene_id", "scene_created_us", "circumstances")
        return CapturedCall(
            **{name: header[name] for name in names},
            attributes=_attributes_of(header["attributes"]),
            parts=tuple(_part_of(it) for it in header["parts"]),
            request=messages[: header["request_bytes"]],
            response=messages[header["request_bytes"] :],
        )
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError, codec.Damaged) as error:
        raise DamagedCapture(f"its header is not one of ours: {error}") from error


def _attributes_of(content: object) -> SceneAttributes:
    if content is None:
        return SceneAttributes()
    data = json.dumps(content).encode()
    return codec.decode_attributes("", data, codec.sha256_for("", data))


def _part_to_dict(part: CapturedPart) -> dict[str, Any]:
    choice, *others = map(_choice_to_dict, part.choices) if part.choices else (None,)
    return {
        "field": part.field,
        "generation": part.generation,
        "references": [_reference_to_dict(it) for it in part.references],
        "choice": choice,
        "other_choices": others,
    }


def _part_of(content: Mapping[str, Any]) -> CapturedPart:
    choices = [it for it in (content["choice"], *content.get("other_choices", ())) if it is not None]
    references = tuple(map(_reference_of, content["references"]))
    return CapturedPart(content["field"], content["generation"], references, tuple(map(_choice_of, choices)))


def _choice_to_dict(choice: Choice) -> dict[str, Any]:
    ranked = [
        {
            "reference_id": it.reference_id,
            "key": it.key,
            "similarity": it.similarity,
            "rotation": it.world_from_camera.rotation.tolist(),
            "translation": it.world_from_camera.translation.tolist(),
        }
        for it in choice.references
    ]
    return {"descriptor": choice.descriptor, "generation": choice.generation, "references": ranked}


def _choice_of(content: Mapping[str, Any]) -> Choice:
    ranked = tuple(
        RankedReference(it["reference_id"], it["key"], it["similarity"], _pose_of(it)) for it in content["references"]
    )
    return Choice(ranked, content["descriptor"], content["generation"])


def _reference_to_dict(reference: CapturedReference) -> dict[str, Any]:
    return {
        "reference_id": reference.reference_id,
        "key": reference.key,
        "image": reference.image_sha256,
        "views": dict(reference.views),
        **({"mask": reference.mask_sha256} if reference.mask_sha256 else {}),
        **json.loads(codec.encode_geometry(reference.camera, reference.world_from_camera)),
    }


def _reference_of(content: Mapping[str, Any]) -> CapturedReference:
    geometry = json.dumps({name: content[name] for name in ("camera", "world_from_camera")}).encode()
    camera, world_from_camera = codec.decode_geometry("", geometry, codec.sha256_for("", geometry))
    views = {_text(name): _text(blob) for name, blob in content["views"].items()}
    reference_id, key, image = check_id(content["reference_id"]), _text(content["key"]), _text(content["image"])
    mask = _text(content.get("mask", ""))
    return CapturedReference(reference_id, key, camera, world_from_camera, image, views, mask)


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{type(value).__name__} in place of text")
    return value


def _pose_of(content: Mapping[str, Any]) -> RigidTransform:
    return RigidTransform(np.array(content["rotation"], float), np.array(content["translation"], float))
