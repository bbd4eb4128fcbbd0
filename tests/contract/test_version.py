"""One version, that of pyproject.toml, is everywhere; a release has the schema of the store that is written down."""

import json
import re

from packaging.version import Version
from support.project import PROJECT, ROOT

from mapless_server.store.tables import SCHEMA_VERSION

VERSION = str(PROJECT["version"])
NUMBERS = VERSION.partition(".dev")[0]
"""For what knows no development versions: CMake and package.xml."""
SCHEMAS = {"0.2.0": 3, "0.3.0": 9}
"""The schema of the store of each release. A release with another schema has another version, and so a line here."""


def text(path: str) -> str:
    return (ROOT / path).read_text()


def test_a_release_has_the_schema_that_is_written_down() -> None:
    released = max(SCHEMAS, key=Version)
    assert [*SCHEMAS.values()] == sorted(SCHEMAS.values())
    if ".dev" in VERSION:
        assert Version(VERSION) > Version(released)
        assert SCHEMAS[released] <= SCHEMA_VERSION
    else:
        assert released == VERSION
        assert SCHEMAS[released] == SCHEMA_VERSION


def test_the_page_of_stores_names_the_schemas_of_releases() -> None:
    page = text("docs/operation/stores.md")
    rows = dict(re.findall(r"^\| (\d+\.\d+\.\d+) \| (\d+) \|", page, re.MULTILINE))
    assert {version: int(schema) for version, schema in rows.items()} == SCHEMAS


def test_every_image_has_the_version() -> None:
    named: dict[str, set[str]] = {}
    for folder in ("deploy", "docker", "docs/operation", "docs/guides"):
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and path.suffix in {".md", ".yaml", ""}:
                found = re.findall(r"\bmapless:(\d[\w.]*?)-(?:cpu|cuda|tools|ray)\b", path.read_text())
                found += re.findall(r"newTag: (\d[\w.]*?)-(?:cpu|cuda)\b", path.read_text())
                if found:
                    named[str(path.relative_to(ROOT))] = set(found)
    assert len(named) >= 8
    assert {version for versions in named.values() for version in versions} == {VERSION}, named
    assert re.findall(r"^ARG VERSION=(.+)$", text("docker/Dockerfile"), re.MULTILINE) == [VERSION]


def test_clients_and_packages_have_the_version() -> None:
    assert re.findall(r"^project\(mapless VERSION (\S+) ", text("client/cpp/CMakeLists.txt"), re.MULTILINE) == [NUMBERS]
    for name in ("package.json", "package-lock.json"):
        assert json.loads(text(f"client/web/{name}"))["version"] == VERSION.replace(".dev", "-dev.")
    assert re.findall(r"<version>(.+)</version>", text("deploy/ros2/mapless_ros/package.xml")) == [NUMBERS]
    assert re.findall(r'version="(.+)"', text("deploy/ros2/mapless_ros/setup.py")) == [NUMBERS]


def test_the_changelog_begins_with_the_version_or_what_follows() -> None:
    headings = re.findall(r"^## \[(.+?)\](?: - (\S+))?$", text("CHANGELOG.md"), re.MULTILINE)
    assert headings[0] == ("Unreleased", "")
    releases = [version for version, _ in headings[1:]]
    assert releases == sorted(releases, key=Version, reverse=True)
    assert set(SCHEMAS) <= set(releases)
    assert (releases[0] == VERSION) == (".dev" not in VERSION)
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d", day) for _, day in headings[1:])
