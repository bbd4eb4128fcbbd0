"""The command that installs an extra works for how mapless was installed, and asks no index for a package "mapless"."""

import json
import sys
from pathlib import Path

import pytest

from mapless_command import installation
from mapless_command.installation import IMAGE_EXTRAS, how_to_install

METADATA = """Metadata-Version: 2.4
Name: mapless
Version: 9.8.7
Requires-Dist: numpy>=1.26
Provides-Extra: server
Requires-Dist: typer>=0.15; extra == "server"
Requires-Dist: tomli>=2; python_version < "3.11" and extra == "server"
Provides-Extra: tools
Requires-Dist: mapless[server]; extra == "tools"
Requires-Dist: jinja2>=3.1; (sys_platform == "linux" or python_version > "3") and extra == "tools"
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with metadata of mapless alone on the path, beside the pip of this environment."""
    (tmp_path / "mapless-9.8.7.dist-info").mkdir()
    (tmp_path / "mapless-9.8.7.dist-info" / "METADATA").write_text(METADATA)
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.setattr(installation, "_install", lambda: ["pip", "install"])
    return tmp_path


def came_from(folder: Path, direct_url: object) -> None:
    (folder / "mapless-9.8.7.dist-info" / "direct_url.json").write_text(json.dumps(direct_url))


def test_a_checkout_is_installed_again_with_the_extra(folder: Path) -> None:
    checkout = folder / "my checkout"
    checkout.mkdir()
    came_from(folder, {"url": checkout.as_uri(), "dir_info": {"editable": True}})
    assert how_to_install("tools") == f"pip install --editable '{checkout}[tools]'"
    came_from(folder, {"url": checkout.as_uri(), "dir_info": {}})
    assert how_to_install("tools") == f"pip install '{checkout}[tools]'"


def test_a_wheel_is_named_by_its_address(folder: Path) -> None:
    wheel = folder / "mapless-9.8.7-py3-none-any.whl"
    wheel.touch()
    came_from(folder, {"url": wheel.as_uri(), "archive_info": {}})
    assert how_to_install("tools") == f"pip install 'mapless[tools] @ {wheel.as_uri()}'"
    url = "https://files.example/mapless-9.8.7-py3-none-any.whl"
    came_from(folder, {"url": url, "archive_info": {"hash": "sha256=0"}})
    assert how_to_install("tools") == f"pip install 'mapless[tools] @ {url}'"


def test_a_commit_is_named_by_its_repository(folder: Path) -> None:
    about = {"vcs": "git", "commit_id": "abc", "requested_revision": "main"}
    came_from(folder, {"url": "https://git.example/mapless", "vcs_info": about, "subdirectory": "python"})
    expected = "pip install 'mapless[tools] @ git+https://git.example/mapless@abc#subdirectory=python'"
    assert how_to_install("tools") == expected


@pytest.mark.parametrize("direct_url", [None, {"url": "file:///gone/mapless.whl", "archive_info": {}}])
def test_without_a_source_the_packages_are_named(folder: Path, direct_url: object) -> None:
    if direct_url is not None:
        came_from(folder, direct_url)
    assert how_to_install("server") == "pip install 'typer>=0.15' 'tomli>=2; python_version < \"3.11\"'"
    jinja = '\'jinja2>=3.1; sys_platform == "linux" or python_version > "3"\''
    assert how_to_install("tools") == f"pip install 'typer>=0.15' 'tomli>=2; python_version < \"3.11\"' {jinja}"


def test_sources_alone_name_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "path", [])
    assert how_to_install("tools") == "install the extra tools of mapless"


def test_an_image_is_built_with_the_extra(tmp_path: Path) -> None:
    (tmp_path / IMAGE_EXTRAS).write_text("server,otel\n")
    assert how_to_install("tools", tmp_path) == "build the image with --build-arg EXTRAS=server,otel,tools"


def test_metadata_of_sources_does_not_hide_the_installation(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = folder / "sources"
    (sources / "mapless.egg-info").mkdir(parents=True)
    (sources / "mapless.egg-info" / "PKG-INFO").write_text(METADATA)
    came_from(folder, {"url": sources.as_uri(), "dir_info": {"editable": True}})
    monkeypatch.setattr(sys, "path", [str(sources), str(folder)])
    assert how_to_install("tools") == f"pip install --editable '{sources}[tools]'"
