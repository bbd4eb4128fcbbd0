"""The file of a captured call: all that decided the answer, except the references, which the store has.

first 32   SHA-256 of everything after
header     one line of JSON; floats as the shortest decimal that reads back as the same float64
request    the message
response   the message
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

import numpy as np

from mapless.geometry import RigidTransform
from mapless.names import check_id
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.scenes import Choice, RankedReference
from mapless_server.security import check_tenant
from mapless_server.store import SceneAttributes, codec


class CaptureError(Exception):
    """The folder, or a call in it, cannot be used; the message is one sentence for the operator."""


Request = pb.LocalizeRequest | pb.LocalizeRigRequest | pb.LocalizeSequenceRequest
Response = pb.LocalizeResponse | pb.LocalizeRigResponse | pb.LocalizeSequenceResponse


def diagnostics_of(response: Response) -> list[pb.Diagnostics]:
    """Returns the diagnostics of each photograph, in order."""
    if isinstance(response, pb.LocalizeResponse):
        return [response.diagnostics]
    return [image.diagnostics for image in response.images]


FORMAT_VERSION = 2
READABLE_FORMATS = (1, 2)
"""Format 1, of mapless 0.3, also has each reference's camera, pose and copies, which are not needed."""
_DIGEST_BYTES = 32


@dataclass(frozen=True, eq=False)
class CapturedPart:
    """The named or ranked references that one photograph of a call was compared with, at a generation of the scene.

    The field is the photograph's path in the request, "image" or "images[2].image". The references are keys by id: a
    key is never used again, and what it names never changes. The choices are that of the answer and those by other
    descriptors; none if the caller named the references.
    """

    field: str
    generation: int
    references: Mapping[str, str]
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
        circumstances: all else that decides an answer (versions, settings, weights), by name.
        attributes: attributes of the scene.
        prior_attributes: those of the scene in whose world priors were given, if it is another of several scenes.
        parts: one for each photograph.
        request: the message as it was received.
        response: the message as it was sent.
    """

    request_id: str
    time_s: float
    method: str
    tenant: str
    scene_id: str
    circumstances: Mapping[str, str] = field(default_factory=dict)
    attributes: SceneAttributes = field(default_factory=SceneAttributes)
    prior_attributes: SceneAttributes | None = None
    parts: tuple[CapturedPart, ...] = ()
    request: bytes = b""
    response: bytes = b""

    @property
    def size_bytes(self) -> int:
        """Size of both messages."""
        return len(self.request) + len(self.response)


_PLAIN = ("request_id", "time_s", "method", "tenant", "scene_id", "circumstances")


def encode_call(call: CapturedCall) -> bytes:
    """Encodes a call as the content of its file."""
    header = {
        "format": FORMAT_VERSION,
        **{name: getattr(call, name) for name in _PLAIN},
        "attributes": _attributes_to_json(call.attributes),
        "prior_attributes": None if call.prior_attributes is None else _attributes_to_json(call.prior_attributes),
        "parts": [_part_to_dict(part) for part in call.parts],
        "request_bytes": len(call.request),
    }
    body = b"".join([json.dumps(header, separators=(",", ":")).encode(), b"\n", call.request, call.response])
    return hashlib.sha256(body).digest() + body


def decode_call(data: bytes) -> CapturedCall:
    """Decodes the content of a call's file.

    CaptureError if the file is cut or changed, or has the format of another version. Names and the time are checked,
    since a digest shows damage, but not who wrote the file.
    """
    digest, body = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
    if hashlib.sha256(body).digest() != digest:
        raise CaptureError("it is cut or damaged, or no captured call")
    text, _, messages = body.partition(b"\n")
    try:
        header = json.loads(text)
        if header["format"] not in READABLE_FORMATS:
            raise CaptureError(
                f"it has format {header['format']}, and this program reads up to {FORMAT_VERSION}: replay it with the "
                "version of mapless that captured it, or a later one"
            )
        datetime.fromtimestamp(header["time_s"], timezone.utc)
        check_id(header["scene_id"])
        check_tenant(header["tenant"])
        return CapturedCall(
            **{name: header[name] for name in _PLAIN},
            attributes=_attributes_of(header["attributes"]),
            prior_attributes=_attributes_of(prior) if (prior := header.get("prior_attributes")) else None,
            parts=tuple(_part_of(it) for it in header["parts"]),
            request=messages[: header["request_bytes"]],
            response=messages[header["request_bytes"] :],
        )
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError, codec.Damaged) as error:
        raise CaptureError(f"its header is not one of ours: {error}") from error


def _attributes_to_json(attributes: SceneAttributes) -> Any:
    return json.loads(codec.encode_attributes(attributes) or b"null")


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
        "references": [{"reference_id": name, "key": key} for name, key in part.references.items()],
        "choice": choice,
        "other_choices": others,
    }


def _part_of(content: Mapping[str, Any]) -> CapturedPart:
    choices = [it for it in (content["choice"], *content.get("other_choices", ())) if it is not None]
    references = {check_id(it["reference_id"]): str(it["key"]) for it in content["references"]}
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


def _pose_of(content: Mapping[str, Any]) -> RigidTransform:
    return RigidTransform(np.array(content["rotation"], float), np.array(content["translation"], float))
