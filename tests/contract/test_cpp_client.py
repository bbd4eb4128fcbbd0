"""The C++ client, built with Debian's gRPC and Protobuf, installed, found by CMake, and run against servers."""

import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import grpc
import pytest
from support.certificates import authority, signed
from support.clients import hosted
from support.compilers import needs, run
from support.servers import PHOTO, make_scene, pose, serving

from mapless import Client, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.security import create_token

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "client" / "cpp"

nightly = pytest.mark.nightly("cpp")


def cmake(source: Path, build: Path, *definitions: str) -> None:
    run("cmake", "-S", source, "-B", build, *(f"-D{it}" for it in definitions), folder=source)
    run("cmake", "--build", build, "--parallel", "2", folder=source)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the programs `calls`, of the client's build, and `localize`, which has found it installed.

    It takes 20 s of processor time, which compiles all generated C++, too.
    """
    needs("cmake", "g++", "protoc", "grpc_cpp_plugin")
    folder = tmp_path_factory.mktemp("cpp")
    cmake(SOURCE, folder / "client", "MAPLESS_BUILD_TESTS=ON", f"CMAKE_INSTALL_PREFIX={folder / 'installed'}")
    run("cmake", "--install", folder / "client", folder=folder)
    shutil.copytree(SOURCE / "example", folder / "example")  # nothing of the source tree is beside it
    cmake(folder / "example", folder / "program", f"CMAKE_PREFIX_PATH={folder / 'installed'}")
    return folder


@pytest.fixture
def localize(built: Path, tmp_path: Path) -> Callable[..., tuple[int, str]]:
    """Runs the example: exit code, and what it prints to both outputs."""
    (tmp_path / "photo.png").write_bytes(PHOTO)

    def localize(address: str, scene: str = "s", **environment: str) -> tuple[int, str]:
        numbers = ("96", "64", "80", "81", "47.5", "31.5")
        done = subprocess.run(
            [str(built / "program" / "localize"), address, scene, str(tmp_path / "photo.png"), *numbers],
            env={**os.environ, "GRPC_VERBOSITY": "NONE", **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=60,
        )
        return done.returncode, done.stdout

    return localize


@nightly
def test_every_call_of_the_cpp_client(built: Path, tmp_path: Path) -> None:
    """Its own program checks the answers, the errors' types and details, retries, deadlines, threads."""
    (tmp_path / "photo.png").write_bytes(PHOTO)
    with serving(tmp_path / "data") as server:
        command = [str(built / "client" / "calls"), server.address, str(tmp_path / "photo.png")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "well\n"), done.stderr


@nightly
def test_the_cpp_example_with_tls_and_a_token(localize: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    ours, data = authority(), tmp_path / "data"
    (tmp_path / "ca.pem").write_bytes(ours.certificate_pem)
    signed(ours, "server").write(tmp_path / "tls.pem", tmp_path / "tls.key")
    token = create_token(tmp_path / "tokens.json", "robot", "default", "localize", None)
    with serving(data) as server, Client(server.address) as client:
        make_scene(client, "s", 1)
        code, printed = localize(server.address)
        assert (code, printed.splitlines()[0]) == (0, "localized, 90 of 120 matches agree")
        assert "position  0.000 2.000 -1.000 m" in printed
        assert localize(server.address, "nowhere") == (1, "NOT_FOUND: there is no scene 'nowhere', field scene\n")
    tls: dict[str, Any] = {"tls_certificate": tmp_path / "tls.pem", "tls_key": tmp_path / "tls.key"}
    with serving(data, tokens_file=tmp_path / "tokens.json", **tls) as server:
        authorities = {"MAPLESS_CA": str(tmp_path / "ca.pem")}
        assert localize(server.address, **authorities, MAPLESS_TOKEN=token)[0] == 0
        code, printed = localize(server.address, **authorities, MAPLESS_TOKEN="mapless_wrong")
        assert (code, printed) == (1, "TOKEN_INVALID: the token is unknown\n")
        assert localize(server.address, MAPLESS_TOKEN=token)[1].startswith("the server cannot be reached: ")


class LosingFirst(grpc.GenericRpcHandler):
    """Passes calls on to a server, and loses the first answer to each method."""

    def __init__(self, channel: grpc.Channel) -> None:
        self.channel = channel
        self.seen: set[str] = set()

    def service(self, details: Any) -> Any:
        def answer(request: bytes, context: Any) -> bytes:
            is_first = details.method not in self.seen
            self.seen.add(details.method)
            try:
                response: bytes = self.channel.unary_unary(details.method)(request, timeout=30)
            except grpc.RpcError as error:
                failure: Any = error
                context.set_trailing_metadata(failure.trailing_metadata())
                context.abort(failure.code(), failure.details())
            if is_first:
                context.abort(grpc.StatusCode.INTERNAL, "Received RST_STREAM with error code 2")
            return response

        return grpc.unary_unary_rpc_method_handler(answer)


@nightly
def test_the_cpp_client_looks_up_a_change_whose_answer_was_lost(built: Path, tmp_path: Path) -> None:
    (tmp_path / "photo.png").write_bytes(PHOTO)
    with (
        serving(tmp_path / "data") as server,
        grpc.insecure_channel(server.address) as channel,
        hosted(LosingFirst(channel)) as address,
    ):
        command = [str(built / "client" / "calls"), address, str(tmp_path / "photo.png"), "lost"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "well\n"), done.stderr


class Newer(grpc.GenericRpcHandler):
    """Away twice; then a coarse pose, and an answer with a value and a field that are newer than the client."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    def service(self, details: Any) -> Any:
        self.calls.append(details.method)
        return grpc.unary_stream_rpc_method_handler(self.answers)

    def answers(self, _: bytes, context: Any) -> Iterator[bytes]:
        if len(self.calls) < 3:
            context.abort(grpc.StatusCode.UNAVAILABLE, "away")
        coarse = pb.LocalizeResponse(
            localization=pb.Localization(world_from_camera=wire.transform_to_message(pose(4.0)))
        )
        yield pb.LocalizeProgressivelyResponse(answer=coarse).SerializeToString()
        rejection = pb.Rejection(message="of tomorrow", reason=77)  # type: ignore[arg-type]
        answer = pb.LocalizeResponse(rejection=rejection).SerializeToString() + b"\xf2\x3f\x03new"  # field 1022
        yield b"\x0a" + bytes([len(answer)]) + answer + b"\x10\x01"


@nightly
def test_the_cpp_client_repeats_and_reads_newer_answers(localize: Callable[..., tuple[int, str]]) -> None:
    handler = Newer()
    with hosted(handler) as address:
        code, printed = localize(address)
    first, position, _, last = printed.splitlines()
    assert (code, first) == (3, "localized; the final answer follows")
    assert position.startswith("position  4.000 2.000 -1.000 m")
    assert last == "not localized: 77: of tomorrow"
    assert handler.calls == ["/mapless.v1.LocalizationService/LocalizeProgressively"] * 3


def test_the_cpp_client_has_the_packages_version() -> None:
    (version,) = re.findall(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    version = version.partition(".dev")[0]  # CMake's versions are numbers
    assert f"project(mapless VERSION {version} " in (SOURCE / "CMakeLists.txt").read_text()
    minor = version.rpartition(".")[0]
    assert f"find_package(mapless {minor} REQUIRED)" in (SOURCE / "example" / "CMakeLists.txt").read_text()
