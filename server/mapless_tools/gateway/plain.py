"""One photograph as a form, for curl: converts it, and its intrinsics if there are any, to a request of Localize."""

from collections.abc import AsyncGenerator
from typing import Any

from google.protobuf.json_format import MessageToDict, Parse, ParseError
from starlette.datastructures import Headers, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from mapless.names import scene_name
from mapless.text_files import decode_text
from mapless.v1 import localization_service_pb2 as pb

from .guard import Failure, checked_json

FIELDS = ("image", "intrinsics", "scene", "request", "mask")
_MAX_PART_BYTES = 2**20


async def read_form(headers: Headers, body: AsyncGenerator[bytes, None]) -> pb.LocalizeRequest:
    """Reads the request that a form describes, perhaps without a scene; Failure names the wrong field."""
    if not headers.get("content-type", "").startswith("multipart/form-data"):
        example = "curl -F image=@photo.jpg"
        raise Failure(f"must be multipart/form-data, as of {example}", 415, field="content-type")
    parts = await _parts(headers, body)
    request = pb.LocalizeRequest()
    _parse(parts.get("request", b"{}"), request, "request")
    if "intrinsics" in parts:
        _parse(parts["intrinsics"], request.intrinsics, "intrinsics")
    request.image = parts.get("image", request.image)
    if not request.image:
        raise Failure("is missing or empty", field="image")
    if "mask" in parts:
        request.mask = parts["mask"]
    scene = parts["scene"].decode(errors="replace") if "scene" in parts else request.scene
    if scene:
        request.scene = scene_name(scene)
    return request


async def _parts(headers: Headers, body: AsyncGenerator[bytes, None]) -> dict[str, bytes]:
    """The bytes of each field. Photographs stay in memory and are never written to a disk."""
    parser = MultiPartParser(
        headers, body, max_files=len(FIELDS), max_fields=len(FIELDS), max_part_size=_MAX_PART_BYTES
    )
    parser.spool_max_size = 2**40
    try:
        form = await parser.parse()
    except MultiPartException as error:
        raise Failure(f"the form cannot be read: {error.message}") from None
    parts: dict[str, bytes] = {}
    for name, value in form.multi_items():
        if name not in FIELDS:
            raise Failure(f"the form has {', '.join(FIELDS)}, not {name[:40]!a}", field=name[:40])
        if name in parts:
            raise Failure("is given twice", field=name)
        parts[name] = await value.read() if isinstance(value, UploadFile) else value.encode()
    return parts


def _parse(text: bytes, message: Any, field: str) -> None:
    try:
        Parse(decode_text(bytes(checked_json(text, field)), "the file"), message)
    except (ParseError, ValueError, RecursionError) as error:
        raise Failure(f"is not the JSON of a {message.DESCRIPTOR.name}: {str(error)[:300]}", field=field) from None


def to_json(response: pb.LocalizeResponse) -> dict[str, Any]:
    """An answer with the interface's names, including numbers that are zero."""
    content: dict[str, Any] = MessageToDict(
        response, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
    )
    return content
