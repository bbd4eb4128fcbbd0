"""The grpcurl lines of the pages are right: services, methods, types and fields as a server describes itself.

What stands on a line is read as grpcurl reads it, and the request it would send is built from the server's own
description, by nothing that mapless ships.
"""

import base64
import json
import re
import shlex
from collections.abc import Iterator
from typing import Any

import grpc
import pytest
from google.protobuf import descriptor_pool, json_format, message_factory
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from support.documents import PAGES, shell
from support.servers import CAMERA, PHOTO, make_scene, serving

from mapless import Client, wire

SHOWN = "\n".join(map(shell, PAGES))
FLAGS = {"-plaintext": 0, "-d": 1, "-max-msg-sz": 1, "-cacert": 1, "-H": 1}
"""Flags that the pages use, and how many values each takes."""


def lines() -> list[tuple[dict[str, str], list[str]]]:
    """The flags of each call of grpcurl that the pages show; and its other words: address, method or verb, symbols."""
    found = []
    for after in SHOWN.split("grpcurl -")[1:]:
        text, *rest = f"-{after}".split("\n")
        while text.count("'") % 2:  # a quotation that ends in a later line
            text += rest.pop(0)
        words, flags = shlex.split(text), dict[str, str]()
        while words[0].startswith("-"):
            name = words.pop(0)
            flags[name] = words.pop(0) if FLAGS[name] else ""
        found.append((flags, words))
    return found


def as_protobuf_json(body: str) -> str:
    """JSON as grpcurl reads it, but for field masks: a string in protobuf's JSON, a message for grpcurl."""

    def with_masks(message: dict[str, Any]) -> dict[str, Any]:
        for name in {"update_mask", "updateMask"} & {*message}:
            paths = message[name]["paths"]  # protobuf's string has JSON's names
            message[name] = ",".join(re.sub(r"_([a-z])", lambda it: it[1].upper(), it) for it in paths)
        return message

    return json.dumps(json.loads(body, object_hook=with_masks))


class Described:
    """A server's interface as it describes it."""

    def __init__(self, channel: grpc.Channel) -> None:
        self.channel = channel
        self.pool = descriptor_pool.DescriptorPool(ProtoReflectionDescriptorDatabase(channel))

    def method(self, name: str) -> Any:
        service, _, method = name.partition("/")
        return self.pool.FindServiceByName(service).methods_by_name[method]

    def request(self, method: str, body: str) -> Any:
        """The message that a JSON body is; an error if a name in it is none."""
        kind = message_factory.GetMessageClass(self.method(method).input_type)
        return json_format.Parse(as_protobuf_json(body), kind())


@pytest.fixture(scope="module")
def described(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Described]:
    with serving(tmp_path_factory.mktemp("data")) as running, Client(running.address) as client:
        make_scene(client, "kitchen", 2)
        with grpc.insecure_channel(running.address) as channel:
            yield Described(channel)


def test_no_line_is_overlooked() -> None:
    """Wherever a page shows one: fenced, whatever the language, or indented."""
    assert len(lines()) >= 7
    assert {words[0] for _, words in lines()} == {"localhost:50051"}
    for page in PAGES:
        assert len(re.findall(r"grpcurl -\w", page.read_text())) == shell(page).count("grpcurl -"), page


def test_every_symbol_is_described(described: Described) -> None:
    for flags, (_, verb, *symbols) in lines():
        if verb == "describe":
            for symbol in symbols:
                described.pool.FindFileContainingSymbol(symbol)
        elif verb != "list":
            body = flags.get("-d", "{}")
            described.request(verb, "{}" if body == "@" else body)
    with pytest.raises(json_format.ParseError, match="photo"):
        described.request("mapless.v1.LocalizationService/Localize", '{"photo": ""}')


def test_the_request_that_the_shell_puts_together_is_answered(described: Described) -> None:
    """The output of `printf`, `cat` and `base64` for grpcurl's standard input is a request, and it localizes."""
    written = re.findall(r"printf '([^']*)'", SHOWN)
    prefix, suffix = written[:2]
    assert {*written} == {prefix, suffix}  # wherever it is shown
    body = prefix.replace("%s", json_format.MessageToJson(wire.camera_to_message(CAMERA)))
    body += base64.b64encode(PHOTO).decode() + suffix
    flags, (_, method) = next(line for line in lines() if line[0].get("-d") == "@")
    request = described.request(method, body)
    assert json.loads(body)["scene"] == request.scene == "scenes/kitchen"
    answer = described.channel.unary_unary(
        f"/{method}",
        request_serializer=type(request).SerializeToString,
        response_deserializer=message_factory.GetMessageClass(described.method(method).output_type).FromString,
    )(request, timeout=30)
    assert answer.localization.world_from_camera.translation_m.y == 2.0
    assert int(flags["-max-msg-sz"]) == 32 * 2**20
