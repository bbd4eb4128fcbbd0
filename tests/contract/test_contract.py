"""What callers rely on: every RPC answers, generated code is that of the protos, and imports go one way."""

from __future__ import annotations

import filecmp
import importlib.metadata
import inspect
import os
import subprocess
import sys
from enum import Enum
from pathlib import Path
from typing import Any

import pytest
from support.programs import printed
from support.servers import CAMERA, PHOTO, pose, serving

import mapless
import mapless_server
from mapless import Client, NewReference, wire
from mapless.axes import Axes
from mapless.v1 import localization_service_pb2, reference_service_pb2
from mapless_server.method.options import ScaleStrategy, Variant
from mapless_server.method.priors.known import PriorKind
from mapless_server.method.rejection import Advice, RejectionReason
from mapless_server.method.results import PoseStage, ScaleStage
from mapless_server.services.localization import LocalizationService
from mapless_server.services.references import ReferenceService

ROOT = Path(__file__).parents[2]
SERVICES = [
    (localization_service_pb2, "LocalizationService", LocalizationService),
    (reference_service_pb2, "ReferenceService", ReferenceService),
]
RPCS = [
    (servicer, method.name)
    for module, name, servicer in SERVICES
    for method in module.DESCRIPTOR.services_by_name[name].methods
]


@pytest.mark.parametrize(("servicer", "rpc"), RPCS)
def test_every_rpc_is_implemented(servicer: type, rpc: str) -> None:
    assert rpc in vars(servicer)
    assert inspect.iscoroutinefunction(vars(servicer)[rpc])


@pytest.mark.parametrize(
    "here", [Variant, ScaleStrategy, RejectionReason, PoseStage, ScaleStage, Advice, PriorKind, Axes]
)
def test_enums_have_the_same_values_here_and_on_the_wire(here: type[Enum]) -> None:
    on_the_wire: Any = getattr(localization_service_pb2, here.__name__)
    prefix = wire.enum_prefix(on_the_wire)
    assert {prefix + value.name for value in here} == {*on_the_wire.keys()} - {prefix + "UNSPECIFIED"}


def test_generated_code_is_that_of_the_protos(tmp_path: Path) -> None:
    proto_python = os.environ.get("PROTO_PYTHON")
    if not proto_python:
        pytest.skip("PROTO_PYTHON is not set: no generator; `make test` sets it")
    protos = sorted(str(path) for path in (ROOT / "proto").rglob("*.proto"))
    outputs = [f"--{kind}={tmp_path}" for kind in ("python_out", "pyi_out", "grpc_python_out")]
    subprocess.run(
        [proto_python, "-m", "grpc_tools.protoc", "-I", str(ROOT / "proto"), *outputs, *protos], check=True, timeout=60
    )
    fresh, committed = tmp_path / "mapless" / "v1", ROOT / "client" / "mapless" / "v1"
    names = sorted(path.name for path in fresh.iterdir())
    assert names == sorted(path.name for path in committed.glob("*_pb2*"))
    _, different, missing = filecmp.cmpfiles(fresh, committed, names, shallow=False)
    assert not different + missing, "run `make proto`"


def test_the_client_imports_nothing_heavy() -> None:
    modules = printed("import mapless, mapless.__main__, sys; print(*sys.modules)").split()
    imported = {name.partition(".")[0] for name in modules}
    heavy = {"torch", "cv2", "scipy", "sqlalchemy", "pydantic", "typer", "poselib", "grpc_status"}
    assert imported & (heavy | {"mapless_server"}) == set()
    assert {"grpc", "numpy"} <= imported


def test_the_public_names() -> None:
    assert len({*mapless.__all__}) == len(mapless.__all__)
    for name in mapless.__all__:
        assert hasattr(mapless, name)
    assert importlib.metadata.version("mapless") == mapless_server.__version__


REFLECTING_CALLER = '''
"""Calls a server as grpcurl does: all it knows of the interface comes from the server."""
import atexit, json, sys
import grpc
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from grpc_reflection.v1alpha import reflection_pb2

address, version, request = sys.argv[1:]
channel = grpc.insecure_channel(address)
atexit.register(channel.close)  # an open one may keep the interpreter from ending
reflect = channel.stream_stream(
    f"/grpc.reflection.{version}.ServerReflection/ServerReflectionInfo",
    request_serializer=reflection_pb2.ServerReflectionRequest.SerializeToString,
    response_deserializer=reflection_pb2.ServerReflectionResponse.FromString,
)

def ask(**question):
    return next(reflect(iter([reflection_pb2.ServerReflectionRequest(**question)]), timeout=20))

services = [service.name for service in ask(list_services="").list_services_response.service]
files = {}

def collect(response):
    for data in response.file_descriptor_response.file_descriptor_proto:
        file = descriptor_pb2.FileDescriptorProto.FromString(data)
        if file.name not in files:
            files[file.name] = file
            for dependency in file.dependency:
                collect(ask(file_by_filename=dependency))

collect(ask(file_containing_symbol="mapless.v1.LocalizationService"))
pool = descriptor_pool.DescriptorPool()

def add(name):
    file = files.pop(name, None)
    if file is not None:
        for dependency in file.dependency:
            add(dependency)
        pool.Add(file)

for name in list(files):
    add(name)
method = pool.FindServiceByName("mapless.v1.LocalizationService").methods_by_name["Localize"]
message = json_format.ParseDict(json.loads(request), message_factory.GetMessageClass(method.input_type)())
call = channel.unary_unary(
    "/mapless.v1.LocalizationService/Localize",
    request_serializer=lambda message: message.SerializeToString(),
    response_deserializer=message_factory.GetMessageClass(method.output_type).FromString,
)
response = json_format.MessageToDict(call(message, timeout=20), preserving_proto_field_name=True)
assert not [name for name in sys.modules if name.startswith("mapless")]
print(json.dumps({"services": services, "response": response}))
'''


@pytest.mark.parametrize("version", ["v1", "v1alpha"])
def test_a_caller_with_nothing_but_reflection_localizes(tmp_path: Path, version: str) -> None:
    import base64
    import json

    from google.protobuf import json_format

    with serving(tmp_path) as server, Client(server.address) as client:
        client.create_scene("s")
        client.add_reference("s", NewReference("r", PHOTO, CAMERA, pose(1.5)))
        request = {
            "scene": "scenes/s",
            "image": base64.b64encode(PHOTO).decode(),
            "intrinsics": json_format.MessageToDict(wire.camera_to_message(CAMERA)),
            "options": {"variant": "VARIANT_FULL"},
        }
        done = subprocess.run(
            [sys.executable, "-c", REFLECTING_CALLER, server.address, version, json.dumps(request)],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout)
    assert {"mapless.v1.LocalizationService", "mapless.v1.ReferenceService", "grpc.health.v1.Health"} <= set(
        answer["services"]
    )
    assert answer["response"]["localization"]["world_from_camera"]["translation_m"]["x"] == 1.5
    assert answer["response"]["diagnostics"]["variant"] == "VARIANT_FULL"


def test_reflection_can_be_turned_off(tmp_path: Path) -> None:
    with serving(tmp_path, reflection=False) as server:
        done = subprocess.run(
            [sys.executable, "-c", REFLECTING_CALLER, server.address, "v1alpha", "{}"],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
    assert "UNIMPLEMENTED" in done.stderr
