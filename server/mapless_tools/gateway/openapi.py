"""The description of the gateway: as OpenAPI 3.1 for programs, and as a self-contained page for people."""

import json
from functools import cache
from importlib.resources import files
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from pydantic.json_schema import models_json_schema

from mapless.v1 import localization_service_pb2 as pb
from mapless_server import __version__
from mapless_tools.output_files import render

from . import messages

_SCHEMAS = "#/components/schemas/"
_TYPES = {
    FieldDescriptor.CPPTYPE_BOOL: {"type": "boolean"},
    FieldDescriptor.CPPTYPE_DOUBLE: {"type": "number"},
    FieldDescriptor.CPPTYPE_FLOAT: {"type": "number"},
    FieldDescriptor.CPPTYPE_INT32: {"type": "integer"},
    FieldDescriptor.CPPTYPE_INT64: {"type": "string", "format": "int64"},
    FieldDescriptor.CPPTYPE_STRING: {"type": "string"},
}
_WELL_KNOWN = {
    "google.protobuf.Timestamp": {"type": "string", "format": "date-time"},
    "google.protobuf.Duration": {"type": "string"},
}


@cache
def description() -> dict[str, Any]:
    """The OpenAPI document: openapi.json, with the messages' schemas and the paths of scenes."""
    document: dict[str, Any] = json.loads((files(__package__) / "openapi.json").read_text("utf-8"))
    document["info"]["version"] = __version__
    schemas, paths = document["components"]["schemas"], document["paths"]
    _, models = models_json_schema(
        [(messages.Request, "validation"), (messages.Response, "serialization")], ref_template=f"{_SCHEMAS}{{model}}"
    )
    schemas |= models["$defs"]
    _add_message(pb.LocalizeRequest.DESCRIPTOR, schemas)
    _add_message(pb.LocalizeResponse.DESCRIPTOR, schemas)
    in_scene = {
        method: it | {"operationId": f"{it['operationId']}_in_scene"} for method, it in paths["/geopose"].items()
    }
    paths["/scenes/{scene}/geopose"] = {"parameters": [{"$ref": "#/components/parameters/scene"}], **in_scene}
    return document


@cache
def page() -> str:
    """The page about it."""
    return render("gateway.html", **description())


def _add_message(message: Any, schemas: dict[str, Any]) -> None:
    if message.full_name in schemas:
        return
    properties: dict[str, Any] = {}
    schemas[message.full_name] = {"type": "object", "properties": properties}
    for field in message.fields:
        value = _field_schema(field, schemas)
        properties[field.name] = {"type": "array", "items": value} if field.is_repeated else value


def _field_schema(field: FieldDescriptor, schemas: dict[str, Any]) -> dict[str, Any]:
    if field.enum_type is not None:
        return {"type": "string", "enum": [it.name for it in field.enum_type.values]}
    if field.message_type is None:
        if field.type == FieldDescriptor.TYPE_BYTES:
            return {"type": "string", "contentEncoding": "base64"}
        return _TYPES[field.cpp_type]
    name = field.message_type.full_name
    if name in _WELL_KNOWN:
        return _WELL_KNOWN[name]
    _add_message(field.message_type, schemas)
    return {"$ref": f"{_SCHEMAS}{name}"}
