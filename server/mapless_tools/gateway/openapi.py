"""The description of the gateway: as OpenAPI 3.1 for programs, and as a self-contained page for people."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from pydantic.json_schema import models_json_schema

from mapless.v1 import localization_service_pb2 as pb
from mapless_server import __version__

from . import geopose, messages

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
_ERRORS = {
    400: "The request is wrong; `field` says where.",
    401: "The token is missing or unknown.",
    403: "The token's role does not suffice, or the page's origin is not allowed.",
    404: "No such scene.",
    406: "Another version of the protocol is asked for.",
    408: "The request did not arrive in time.",
    409: "The scene has no datum.",
    413: "The request is too large.",
    415: "The body is of another type.",
    422: "The photograph was not localized; `reason` and `hint` say why, and what helps.",
    429: "Too many calls wait; try again after `retry-after` seconds.",
    502: "A fault of the server behind the gateway.",
    503: "The gateway or the server is busy or starts; try again.",
    504: "No answer in time.",
}


@cache
def description() -> dict[str, Any]:
    """The OpenAPI document."""
    _, models = models_json_schema(
        [(messages.Request, "validation"), (messages.Response, "serialization")], ref_template=f"{_SCHEMAS}{{model}}"
    )
    schemas = {"Error": _error_schema(), **models["$defs"]}
    _add_message(pb.LocalizeRequest.DESCRIPTOR, schemas)
    _add_message(pb.LocalizeResponse.DESCRIPTOR, schemas)
    scene = {"name": "scene", "in": "path", "required": True, "schema": {"type": "string"}, "description": "Its id."}
    form = {
        "type": "object",
        "required": ["image", "intrinsics"],
        "properties": {
            "image": {
                "type": "string",
                "contentMediaType": "application/octet-stream",
                "description": "JPEG, PNG, WebP.",
            },
            "intrinsics": {"$ref": f"{_SCHEMAS}mapless.v1.CameraIntrinsics"},
            "scene": {"type": "string", "description": "Id of the scene; by default the gateway's."},
            "request": {
                "$ref": f"{_SCHEMAS}mapless.v1.LocalizeRequest",
                "description": "All else of a call: priors, references, options.",
            },
        },
    }
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "mapless gateway",
            "version": __version__,
            "description": "Localizes photographs. Calls of browsers (gRPC-Web, Connect) have the paths of gRPC, "
            "/mapless.v1.LocalizationService/Localize; their description is the interface itself.",
        },
        "paths": {
            "/geopose": _geopose_path([]),
            "/scenes/{scene}/geopose": _geopose_path([scene]),
            "/v1/localize": {
                "post": _operation(
                    "localize",
                    "Localizes a photograph; that it was not localized is an answer, `rejection`.",
                    {"multipart/form-data": {"schema": form, "encoding": {"image": {"contentType": "image/*"}}}},
                    {"application/json": {"schema": {"$ref": f"{_SCHEMAS}mapless.v1.LocalizeResponse"}}},
                    without=(406, 409, 422),
                )
            },
        },
        "components": {
            "schemas": schemas,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer", "description": "Of the server."}},
        },
        "security": [{}, {"token": []}],
    }


@cache
def page() -> str:
    """The page about it."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((files(__package__) / "docs.html.j2").read_text())
    return template.render(description())


def _geopose_path(parameters: list[Any]) -> dict[str, Any]:
    request, response = ({"schema": {"$ref": f"{_SCHEMAS}{name}"}} for name in ("Request", "Response"))
    suffix = "_in_scene" if parameters else ""
    return {
        **({"parameters": parameters} if parameters else {}),
        "get": {
            "operationId": f"status{suffix}",
            "summary": "Whether the server serves.",
            "responses": {"200": {"description": "It does."}, "503": {"description": "It does not, or not yet."}},
        },
        "post": _operation(
            f"geopose{suffix}",
            "Open AR Cloud's GeoPose Protocol, version 2: localizes a photograph in a scene with a datum.",
            {"application/json": request},
            {geopose.MEDIA_TYPE: response},
        ),
    }


def _operation(
    name: str, summary: str, body: dict[str, Any], answer: dict[str, Any], without: tuple[int, ...] = ()
) -> dict[str, Any]:
    error = {"application/json": {"schema": {"$ref": f"{_SCHEMAS}Error"}}}
    errors = {
        str(code): {"description": text, "content": error} for code, text in _ERRORS.items() if code not in without
    }
    return {
        "operationId": name,
        "summary": summary,
        "requestBody": {"required": True, "content": body},
        "responses": {"200": {"description": "The answer.", "content": answer}, **errors},
    }


def _error_schema() -> dict[str, Any]:
    members = {
        "reason": "For programs, stable.",
        "message": "For people: what is wrong, and where.",
        "field": "Where in the request.",
        "request_id": "Finds the call in the server's log.",
        "hint": "What helps, for people.",
    }
    properties = {name: {"type": "string", "description": text} for name, text in members.items()}
    error = {"type": "object", "required": ["reason", "message"], "properties": properties}
    return {"type": "object", "required": ["error"], "properties": {"error": error}}


def _add_message(message: Any, schemas: dict[str, Any]) -> None:
    """Adds the JSON schema of a message and of those in it."""
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
