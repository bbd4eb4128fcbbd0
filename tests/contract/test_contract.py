"""The contract with callers: every RPC answers, generated code is that of the protos, and imports go one way."""

import filecmp
import importlib.metadata
import inspect
import os
import re
import subprocess
from enum import Enum
from pathlib import Path
from typing import Any

import grpc
import pytest
from grpc._cython import cygrpc
from grpc_reflection.v1alpha import reflection_pb2
from support.programs import printed
from support.servers import serving

import mapless
import mapless_server
from mapless import wire
from mapless.axes import Axes
from mapless.v1 import localization_service_pb2, reference_service_pb2
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.bundle.priors import PriorKind
from mapless_server.method.options import ScaleStrategy, Variant
from mapless_server.method.rejection import Advice, IntrinsicsParameter, RejectionReason
from mapless_server.method.structure.model import ScaleStage
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
    "here",
    [Variant, ScaleStrategy, RejectionReason, PoseStage, ScaleStage, Advice, PriorKind, IntrinsicsParameter, Axes],
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


def reflected(address: str, version: str) -> set[str]:
    """The services that a server names by one version of reflection; it describes the first of ours, too."""
    questions: list[dict[str, Any]] = [
        {"list_services": ""},
        {"file_containing_symbol": "mapless.v1.LocalizationService"},
    ]
    with grpc.insecure_channel(address) as channel:
        ask = channel.stream_stream(
            f"/grpc.reflection.{version}.ServerReflection/ServerReflectionInfo",
            reflection_pb2.ServerReflectionRequest.SerializeToString,
            reflection_pb2.ServerReflectionResponse.FromString,
        )
        requests = iter([reflection_pb2.ServerReflectionRequest(**it) for it in questions])
        listed, described = ask(requests, timeout=20)
    assert described.file_descriptor_response.file_descriptor_proto
    return {it.name for it in listed.list_services_response.service}


@pytest.mark.parametrize("version", ["v1", "v1alpha"])
def test_reflection_describes_the_services_unless_turned_off(tmp_path: Path, version: str) -> None:
    with serving(tmp_path / "open") as server:
        ours = {"mapless.v1.LocalizationService", "mapless.v1.ReferenceService", "grpc.health.v1.Health"}
        assert ours <= reflected(server.address, version)
    with serving(tmp_path / "closed", reflection=False) as server, pytest.raises(grpc.RpcError, match="UNIMPLEMENTED"):
        reflected(server.address, version)


KNOWN = Path(cygrpc.__file__).read_bytes()
SOURCES = [path for package in (mapless, mapless_server) for path in Path(package.__path__[0]).rglob("*.py")]
OPTIONS = sorted({name for path in SOURCES for name in re.findall(r'\("(grpc\.[a-z0-9_.]+)",', path.read_text())})


@pytest.mark.parametrize("name", OPTIONS)
def test_grpc_knows_the_option(name: str) -> None:
    assert name.encode() + b"\0" in KNOWN
