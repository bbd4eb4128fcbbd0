"""The protos in other languages: names that collide with no generated member, Java that compiles, no break."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from google.protobuf.descriptor import Descriptor
from support.compilers import needs, run

from mapless.v1 import geometry_pb2, localization_service_pb2, reference_service_pb2

ROOT = Path(__file__).parents[2]
PROTO = ROOT / "proto"
PROTOS = sorted(str(path.relative_to(PROTO)) for path in PROTO.rglob("*.proto"))
JAVA_RUNTIME = Path("/usr/share/java/protobuf.jar")

MEMBERS = {
    # C++ and Java, of every message; a getter of Java begins with "get".
    *("descriptor", "default_instance", "metadata", "reflection", "class", "unknown_fields", "all_fields"),
    *("serialized_size", "initialization_error_string", "descriptor_for_type", "default_instance_for_type"),
    # Go, C#, Swift, Objective-C, TypeScript
    *("reset", "string", "marshal", "unmarshal", "parser", "types", "description", "debug_description", "hash"),
    *("hash_value", "is_initialized", "self", "superclass", "constructor", "to_string", "value_of", "data", "bytes"),
}
"""Names that generated messages have themselves."""

KEYWORDS = {
    *("and", "as", "assert", "async", "auto", "await", "bool", "break", "case", "catch", "char", "checked", "const"),
    *("continue", "decimal", "default", "defer", "delete", "do", "double", "else", "enum", "event", "export", "extern"),
    *("false", "final", "fixed", "float", "for", "foreach", "from", "fun", "func", "global", "go", "goto", "if"),
    *("in", "init", "inout", "int", "interface", "internal", "is", "lambda", "let", "lock", "long", "map", "module"),
    *("namespace", "native", "new", "none", "not", "null", "object", "operator", "or", "out", "package", "params"),
    *("pass", "private", "protected", "protocol", "public", "raise", "range", "ref", "register", "return", "select"),
    *("short", "signed", "sizeof", "static", "struct", "super", "switch", "template", "this", "throw", "true", "try"),
    *("type", "typedef", "typeof", "union", "unsigned", "using", "val", "var", "virtual", "void", "volatile", "when"),
    *("import", "where", "while", "with", "yield", "near", "far", "small", "unix", "linux", "major", "minor"),
}
"""Keywords of the languages, and macros that system headers define."""

ACCESSORS = ("{}_count", "{}_list", "{}_size", "{}_case", "{}_value", "{}_bytes", "{}_builder", "has_{}", "clear_{}")
"""Generated beside a field; a second field of that name would collide."""


def messages() -> Iterator[Descriptor]:
    for module in (geometry_pb2, localization_service_pb2, reference_service_pb2):
        yield from module.DESCRIPTOR.message_types_by_name.values()


@pytest.mark.parametrize("message", [*messages()], ids=lambda message: message.name)
def test_no_field_has_a_name_that_generated_code_uses(message: Descriptor) -> None:
    names = {field.name for field in message.fields}
    assert not names & (MEMBERS | KEYWORDS)
    for field in message.fields:
        if field.is_repeated or field.message_type is not None or field.enum_type is not None:
            assert not names & {accessor.format(field.name) for accessor in ACCESSORS}
    # Camel case of two names is not the same, whichever way digits are treated.
    assert len({name.replace("_", "") for name in names}) == len(names)


def test_every_proto_names_its_place_in_each_language() -> None:
    for module in (geometry_pb2, localization_service_pb2, reference_service_pb2):
        options = module.DESCRIPTOR.GetOptions()
        assert options.csharp_namespace == "Mapless.V1"
        assert options.go_package == "mapless/v1;maplessv1"
        assert (options.java_package, options.java_multiple_files) == ("mapless.v1", True)
        assert options.objc_class_prefix == "MPL"


def breaking(module: Path) -> str:
    """Findings of buf on a contract compared with the released one; empty if it breaks nothing."""
    buf = Path(sys.executable).parent / "buf"
    done = subprocess.run(
        [buf, "breaking", module, "--against", PROTO / "released.binpb.gz"], capture_output=True, text=True, timeout=60
    )
    return done.stdout + done.stderr


def test_nothing_that_was_released_is_broken(tmp_path: Path) -> None:
    assert breaking(ROOT) == ""
    shutil.copytree(PROTO, tmp_path / "proto")
    shutil.copy(ROOT / "buf.yaml", tmp_path)
    changed = tmp_path / "proto" / "mapless" / "v1" / "geometry.proto"
    changed.write_text(changed.read_text().replace("focal_x_px = 3", "focal_length_px = 3"))
    assert "changed name from" in breaking(tmp_path)


@pytest.mark.nightly
def test_generated_java_compiles(tmp_path: Path) -> None:
    """With the full runtime, whose messages have more members than those of the lite one."""
    needs("protoc", "javac", JAVA_RUNTIME)
    run("protoc", "-I", str(PROTO), "--java_out", str(tmp_path), *PROTOS, folder=tmp_path)
    sources = [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.java")]
    assert "mapless/v1/LocalizeRequest.java" in sources
    run("javac", "-cp", str(JAVA_RUNTIME), "-d", str(tmp_path / "classes"), *sources, folder=tmp_path)
