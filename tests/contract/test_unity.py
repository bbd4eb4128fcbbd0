"""The C# for Unity names fields, enum values and the method as the protos have them."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from mapless.v1 import geometry_pb2, localization_service_pb2

ROOT = Path(__file__).parents[2]
UNITY = ROOT / "client" / "unity"
SOURCE = (UNITY / "MaplessClient.cs").read_text()
MODULES: tuple[Any, ...] = (geometry_pb2, localization_service_pb2)
MESSAGES = {name: it for module in MODULES for name, it in module.DESCRIPTOR.message_types_by_name.items()}


def in_csharp(name: str) -> str:
    """What protoc calls a field: position_95_m becomes Position95M."""
    return re.sub(r"_?([a-z]+|\d+)", lambda part: part.group(1).capitalize(), name)


def fields(message: Any) -> dict[str, Any]:
    return {in_csharp(it.name): it for it in message.fields}


def test_the_names_of_fields_in_csharp() -> None:
    assert (in_csharp("position_95_m"), in_csharp("in_axes"), in_csharp("x")) == ("Position95M", "InAxes", "X")


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


def test_the_method_and_the_axes_exist() -> None:
    service, method = re.findall(r'MethodType\.Unary,\s*"([\w.]+)",\s*"(\w+)"', SOURCE)[0]
    found = localization_service_pb2.DESCRIPTOR.services_by_name["LocalizationService"]
    assert service == found.full_name
    assert found.methods_by_name[method].input_type.name == "LocalizeRequest"
    (axes,) = re.findall(r"Axes = Axes\.(\w+)", SOURCE)
    known: Any = localization_service_pb2.Axes
    assert f"AXES_{axes.upper()}" in {*known.keys()}


def test_the_recipe_names_all_protos_and_they_are_there() -> None:
    recipe = (UNITY / "README.md").read_text().replace("\\\n", " ")
    (line,) = re.findall(r"^ {4}(protoc .*)$", recipe, re.MULTILINE)
    named = {part for part in shlex.split(line) if part.endswith(".proto")}
    assert named == {str(path.relative_to(ROOT)) for path in (ROOT / "proto").rglob("*.proto")}


@pytest.mark.parametrize("name", ["MaplessClient.cs"])
def test_the_copied_file_is_there(name: str) -> None:
    assert f"cp client/unity/{name} " in (UNITY / "README.md").read_text()
