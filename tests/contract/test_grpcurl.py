"""The grpcurl lines of the pages are right: services, methods, types and fields as a server describes itself.

What stands on a line is read as grpcurl reads it, and the request it would send is built from the server's own
description, by nothing that mapless ships.
"""

from __future__ import annotations

import base64
import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import grpc
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc
from support.documents import PAGES, shell
from support.servers import CAMERA, PHOTO, make_scene, serving

from mapless import Client, wire

_FILES: Any = descriptor_pb2  # which is not annotated

SHOWN = "\n".join(map(shell, PAGES))
FLAGS = {"-plaintext": 0, "-d": 1, "-max-msg-sz": 1, "-cacert": 1, "-H": 1}
"""Flags that the pages use, and how many values each takes."""


@dataclass
class Line:
    """What one call of grpcurl asks for."""

    address: str
    symbols: list[str]
    flags: dict[str, str] = field(default_factory=dict)


def parsed(arguments: list[str]) -> Line:
    flags, rest = {}, list(arguments)
    while rest and rest[0].startswith("-"):
        name = rest.pop(0)
        flags[name] = rest.pop(0) if FLAGS[name] else ""
    address, *symbols = rest
    return Line(address, symbols, flags)


def lines() -> list[Line]:
    found = []
    for after in SHOWN.split("grpcurl -")[1:]:
        text, *rest = f"-{after}".split("\n")
        while text.count("'") % 2:  # a quotation that ends in a later line
            text += rest.pop(0)
        found.append(parsed(shlex.split(text)))
    return found


def as_protobuf_json(body: str) -> str:
    """What grpcurl reads, as protobuf defines JSON.

    grpcurl takes a field mask as a message alone, not as the string that is defined. Go's JSON, unlike Python's, has
    neither NaN nor a field twice.
    """

    def with_masks(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        message = dict(pairs)
        if len(message) < len(pairs):
            raise ValueError(f"a field is given twice: {pairs}")
        for name in {"update_mask", "updateMask"} & {*message}:
            if not isinstance(message[name], dict) or set(message[name]) != {"paths"}:
                raise ValueError(f'grpcurl wants {{"paths": [...]}}, not {message[name]!r}')
            # Protobuf's string has JSON's names.
            message[name] = ",".join(re.sub(r"_([a-z])", lambda it: it[1].upper(), it) for it in message[name]["paths"])
        return message

    def refuse(constant: str) -> Any:
        raise ValueError(f"{constant} is no JSON")

    return json.dumps(json.loads(body, object_pairs_hook=with_masks, parse_constant=refuse))


class Described:
    """A server's interface as it describes it."""

    def __init__(self, address: str) -> None:
        self.pool = descriptor_pool.DescriptorPool()
        self._files: set[str] = set()
        with grpc.insecure_channel(address) as channel:
            self._ask_server = reflection_pb2_grpc.ServerReflectionStub(channel).ServerReflectionInfo
            self.services = [it.name for it in self._ask(list_services="").list_services_response.service]
            for service in self.services:
                self._add(self._ask(file_containing_symbol=service))

    def _ask(self, **question: Any) -> Any:
        return next(self._ask_server(iter([reflection_pb2.ServerReflectionRequest(**question)]), timeout=20))

    def _add(self, response: Any) -> None:
        for data in response.file_descriptor_response.file_descriptor_proto:
            file = _FILES.FileDescriptorProto.FromString(data)
            if file.name not in self._files:
                self._files.add(file.name)
                for dependency in file.dependency:
                    self._add(self._ask(file_by_filename=dependency))
                self.pool.Add(file)

    def request(self, method: str, body: str) -> Any:
        """The message that a JSON body is; an error if a name in it is none."""
        service, name = method.split("/")
        kind = self.pool.FindServiceByName(service).methods_by_name[name].input_type
        return json_format.Parse(as_protobuf_json(body), message_factory.GetMessageClass(kind)())


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(tmp_path_factory.mktemp("data")) as running, Client(running.address) as client:
        make_scene(client, "kitchen", 2)
        yield running.address


def test_every_line_is_read() -> None:
    assert len(lines()) >= 7
    assert {line.address for line in lines()} == {"localhost:50051"}


def test_no_line_is_overlooked() -> None:
    """Wherever a page shows one: fenced, whatever the language, or indented."""
    for page in PAGES:
        assert len(re.findall(r"grpcurl -\w", page.read_text())) == shell(page).count("grpcurl -"), page


@pytest.mark.parametrize(
    "body",
    [
        '{"update_mask": "datum"}',
        '{"update_mask": ["datum"]}',
        '{"scene": {"datum": {"latitude_deg": NaN}}}',
        '{"scene": {}, "scene": {}}',
        "{'scene': {}}",
    ],
)
def test_what_grpcurl_does_not_read_is_noticed(body: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011  each says it in its own words
        as_protobuf_json(body)


def test_a_mask_names_fields_as_the_protos_do(server: str) -> None:
    request = Described(server).request(
        "mapless.v1.ReferenceService/UpdateScene", '{"update_mask": {"paths": ["down_in_world", "datum"]}}'
    )
    assert list(request.update_mask.paths) == ["down_in_world", "datum"]


def test_every_symbol_is_described(server: str) -> None:
    described = Described(server)
    assert {"mapless.v1.LocalizationService", "mapless.v1.ReferenceService"} <= {*described.services}
    for line in lines():
        verb, *symbols = line.symbols
        if verb == "describe":
            for symbol in symbols:
                described.pool.FindFileContainingSymbol(symbol)
        elif verb != "list":
            body = line.flags.get("-d", "{}")
            described.request(verb, "{}" if body == "@" else body)


def test_the_request_that_the_shell_puts_together_is_answered(server: str) -> None:
    """What `printf`, `cat` and `base64` write for grpcurl's standard input is a request, and it localizes."""
    written = re.findall(r"printf '([^']*)'", SHOWN)
    prefix, suffix = written[:2]
    assert {*written} == {prefix, suffix}  # wherever it is shown
    body = prefix.replace("%s", json_format.MessageToJson(wire.camera_to_message(CAMERA)))
    body += base64.b64encode(PHOTO).decode() + suffix
    line = next(line for line in lines() if line.flags.get("-d") == "@")
    described = Described(server)
    request = described.request(line.symbols[0], body)
    assert json.loads(body)["scene"] == request.scene == "scenes/kitchen"
    service, name = line.symbols[0].split("/")
    method = described.pool.FindServiceByName(service).methods_by_name[name]
    with grpc.insecure_channel(server) as channel:
        answer = channel.unary_unary(
            f"/{line.symbols[0]}",
            request_serializer=type(request).SerializeToString,
            response_deserializer=message_factory.GetMessageClass(method.output_type).FromString,
        )(request, timeout=30)
    assert answer.localization.world_from_camera.translation_m.y == 2.0
    assert int(line.flags["-max-msg-sz"]) == 32 * 2**20


def test_a_name_that_is_none_is_noticed(server: str) -> None:
    described = Described(server)
    with pytest.raises(json_format.ParseError, match="photo"):
        described.request("mapless.v1.LocalizationService/Localize", '{"photo": ""}')
    with pytest.raises(KeyError):
        described.request("mapless.v1.LocalizationService/Localise", "{}")
