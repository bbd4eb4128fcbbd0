"""The C# for Unity names fields, enum values and methods as the protos have them, and has all but one of these."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapless.v1 import geometry_pb2, localization_service_pb2, reference_service_pb2

ROOT = Path(__file__).parents[2]
UNITY = ROOT / "client" / "unity"
SOURCE = (UNITY / "MaplessClient.cs").read_text()
MODULES: tuple[Any, ...] = (geometry_pb2, localization_service_pb2, reference_service_pb2)
MESSAGES = {name: it for module in MODULES for name, it in module.DESCRIPTOR.message_types_by_name.items()}


def fields(message: Any) -> dict[str, Any]:
    return {re.sub(r"_?([a-z]+|\d+)", lambda part: part.group(1).capitalize(), it.name): it for it in message.fields}


def test_what_is_set_exists() -> None:
    made = re.findall(r"new (?:V1\.)?(\w+)\s*\{((?:[^{}]|\{[^{}]*\})*)\}", SOURCE)
    made += re.findall(r"new (?:V1\.)?(\w+)\s*\{([^{}]*)\}", SOURCE)  # those inside others
    assert {"LocalizeRequest", "LocalizeOptions", "RigidTransform", "Quaternion", "Vector3"} <= {it for it, _ in made}
    for name, body in made:
        if name in MESSAGES:
            own = re.sub(r"new [\w.]+ \{[^{}]*\}", "", body)
            assert {*re.findall(r"(\w+) =", own)} <= {*fields(MESSAGES[name])}, name


def test_what_is_read_exists() -> None:
    chains = re.findall(r"\bResponse((?:\??\.[A-Z]\w+)+)", SOURCE.replace("LocalizeResponse", ""))
    assert len(chains) >= 6
    for chain in chains:
        message = MESSAGES["LocalizeResponse"]
        for name in re.findall(r"\w+", chain):
            field = fields(message)[name.removeprefix("Has")]
            assert name in fields(message) or field.has_presence
            message = field.message_type


def test_every_method_but_the_viewers_is_called() -> None:
    """Each is written out with the types of its request and answer."""
    declared = r"Method<(\w+), (\w+)> (\w+)Method =\s+"
    made = r"MethodOf\(\s*(\w+Service), \"(\w+)\",\s+(\w+)\.Parser, (\w+)\.Parser"
    written = re.findall(declared + made, SOURCE)
    found = set()
    for request, answer, constant, service, method, *parsers in written:
        assert (constant, parsers) == (method, [request, answer])
        found.add((service, method, request, answer))
    expected = {
        (service.name, it.name, it.input_type.name, it.output_type.name)
        for module in MODULES
        for service in module.DESCRIPTOR.services_by_name.values()
        for it in service.methods
    }
    assert expected - found == {("LocalizationService", "WatchQueries", "WatchQueriesRequest", "WatchQueriesResponse")}
    assert found <= expected
    for _, method, _, _ in found:
        assert re.search(rf"(CallAsync|AsyncServerStreamingCall)\({method}Method", SOURCE), method


def test_the_axes_exist() -> None:
    (axes,) = re.findall(r"Axes = Axes\.(\w+)", SOURCE)
    known: Any = localization_service_pb2.Axes
    assert f"AXES_{axes.upper()}" in {*known.keys()}


def test_the_recipe_names_all_protos_and_they_are_there() -> None:
    recipe = (UNITY / "README.md").read_text().replace("\\\n", " ")
    (line,) = re.findall(r"^ {4}(protoc .*)$", recipe, re.MULTILINE)
    named = {part for part in shlex.split(line) if part.endswith(".proto")}
    assert named == {str(path.relative_to(ROOT)) for path in (ROOT / "proto").rglob("*.proto")}


_STAND_INS = """
using System; using System.Net.Http; using System.Net.Sockets; using Grpc.Core;
namespace System.Net.Http {
  public class HttpMessageHandler {}
  public class HttpClientHandler : HttpMessageHandler { public bool UseProxy = true; }
}
namespace Grpc.Core {
  public struct Status {
    public readonly Exception DebugException; public readonly string Detail;
    public Status(string detail, Exception exception) { Detail = detail; DebugException = exception; }
  }
  public class RpcException : Exception { public Status Status; }
}
class Program {
  PARTS
  static void Show(string detail, Exception cause) {
    Console.WriteLine(IsUnsent(new RpcException { Status = new Status(detail, cause) }));
  }
  static Exception Of(SocketError error) { return new Exception("sending", new SocketException((int)error)); }
  static void Main() {
    Show("Error starting gRPC call.", Of(SocketError.ConnectionRefused));
    Show("Error starting gRPC call.", Of(SocketError.HostNotFound));
    Show("Error starting gRPC call. HttpRequestException: client error (Connect): tcp connect error", null);
    Show("Error starting gRPC call.", Of(SocketError.ConnectionReset));
    Show("Error starting gRPC call. HttpRequestException: client error (SendRequest)", null);
    Show("the server is stopping", null);
    var handler = new HttpClientHandler(); UseNoProxy(handler); Console.WriteLine(handler.UseProxy);
  }
}
"""
"""In place of what is not at hand, for the parts of the client that need nothing else."""


def part(begin: str, end: str) -> str:
    """The source from a declaration to the end of its block."""
    start = SOURCE.index(begin)
    return SOURCE[start : SOURCE.index(end, start) + len(end)]


needs_mono = pytest.mark.skipif(
    not (shutil.which("mcs") and shutil.which("mono")), reason="needs mono-mcs and mono-runtime"
)


def printed(tmp_path: Path, source: str) -> list[str]:
    """The words that a program prints."""
    (tmp_path / "parts.cs").write_text(source)
    program = tmp_path / "parts.exe"
    command = ["mcs", "-langversion:7.2", f"-out:{program}", str(tmp_path / "parts.cs")]
    subprocess.run(command, check=True, timeout=120)
    return subprocess.run(
        ["mono", str(program)], check=True, capture_output=True, text=True, timeout=120
    ).stdout.split()


_DEPTH = """
using System;
enum DepthSensor { PhoneLidar }
class ByteString { public byte[] B; public static ByteString CopyFrom(byte[] b) { return new ByteString { B = b }; } }
class DepthImage {
  public ByteString Float32; public int WidthPx, HeightPx; public double UnitM; public DepthSensor Sensor;
}
class Program {
  PARTS
  static void Show(DepthImage depth) { Console.WriteLine(BitConverter.ToString(depth.Float32.B)); }
  static void Main() {
    var millimetres = new byte[] { 0xE8, 0x03, 0, 0, 99, 99, 0xF4, 0x01, 0xD0, 0x07, 99, 99 };
    float[] metres = DepthPlane(millimetres, 6, 2, 2, false);
    Show(DepthMetres(metres, 2, 2));
    Show(DepthMetres(metres, 2, 2, DepthSensor.PhoneLidar, true));
    var plane = new byte[16];
    Buffer.BlockCopy(metres, 0, plane, 0, 16);
    Show(DepthMetres(DepthPlane(plane, 8, 2, 2, true), 2, 2));
    foreach (Action wrong in new Action[] { () => DepthMetres(metres, 2, 3), () => DepthPlane(plane, 8, 2, 3, true) }) {
      try { wrong(); } catch (ArgumentException) { Console.WriteLine("refused"); }
    }
  }
}
"""


@needs_mono
def test_depth_is_sent_as_float_metres(tmp_path: Path) -> None:
    """Planes of ARCore's millimetres with padded rows, of a texture whose bottom row is first, of ARKit's metres."""
    declared = ("public static DepthImage DepthMetres", "public static float[] DepthPlane")
    found = printed(tmp_path, _DEPTH.replace("PARTS", "\n".join(part(it, "\n        }\n") for it in declared)))
    top, bottom = np.array([1.0, 0.0], "<f4"), np.array([0.5, 2.0], "<f4")
    upright = (top.tobytes() + bottom.tobytes()).hex("-").upper()
    assert found == [upright, (bottom.tobytes() + top.tobytes()).hex("-").upper(), upright, "refused", "refused"]


@needs_mono
def test_a_call_that_reached_no_server_is_not_done(tmp_path: Path) -> None:
    """And no proxy is used for this machine."""
    parts = [
        part("private static bool IsUnsent", "\n            }\n"),
        part("private static readonly SocketError[]", "};"),
        part("private static readonly string[] UnconnectedSigns", "};"),
        part("private static void UseNoProxy", "\n        }\n"),
    ]
    found = printed(tmp_path, _STAND_INS.replace("PARTS", "\n".join(parts)))
    assert found == ["True", "True", "True", "False", "False", "False", "False"]
    assert "MayBeDone |= pauseS < leftS && !IsUnsent(error);" in SOURCE
    assert "new Uri(one).IsLoopback" in SOURCE
