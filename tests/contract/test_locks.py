"""The locks have every package in one version each, name no registry, and are what everything installs from."""

import json
import re

import pytest
from support.project import PROJECT, ROOT

from mapless_command.installation import IMAGE_EXTRAS

LINES = [line for line in (ROOT / "requirements.lock").read_text().splitlines() if line[0] != "#"]
WEB = ROOT / "client" / "web"


def normalized(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_each_line_is_a_package_a_version_and_a_platform() -> None:
    for line in LINES:
        assert re.fullmatch(r"[a-z0-9-]+==[0-9][\w.]*( ; [^;#]+)?", line), line


@pytest.mark.parametrize("path", ["requirements.lock", "client/web/package-lock.json"])
def test_a_lock_names_no_registry(path: str) -> None:
    text = (ROOT / path).read_text()
    assert not re.search(r"https?:|git\+|file:|resolved|--(extra-)?index|--find-links|://", text)


def test_every_dependency_of_the_project_is_locked() -> None:
    locked = {normalized(line.partition("==")[0]) for line in LINES}
    wanted = [*PROJECT["dependencies"], *(it for extra in PROJECT["optional-dependencies"].values() for it in extra)]
    wanted = [it for it in wanted if "python_version < '3.11'" not in it]  # older than what the lock is for
    names = {normalized(re.split(r"[\[<>=;~! ]", it, maxsplit=1)[0]) for it in wanted} - {"mapless"}
    assert names <= locked, names - locked


def test_torch_is_locked_by_its_version_alone() -> None:
    (torch,) = [line for line in LINES if line.startswith("torch==")]
    (version,) = re.findall(r"^TORCH_VERSION := (.+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert torch == f"torch=={version}"
    assert not [line for line in LINES if line.startswith(("nvidia-", "triton"))]


def test_set_up_pages_and_images_install_from_the_lock() -> None:
    makefile = (ROOT / "Makefile").read_text()
    assert "LOCKED  = --constraint requirements.lock" in makefile
    assert re.search(r"^\$\(VENV\)/\.installed: .*requirements\.lock", makefile, re.MULTILINE)
    own = ("$(PROTO_TOOLS)", "$(KAPTURE)")  # exact versions
    for line in re.findall(r"^\t.*(?:\$\(INSTALL\)|pip install) .*", makefile, re.MULTILINE):
        assert "$(LOCKED)" in line or line.endswith(own), line
    dockerfile = (ROOT / "docker" / "Dockerfile").read_text()
    for line in re.findall(r"pip install .*", dockerfile):
        assert "--constraint requirements.lock" in line
    assert dockerfile.count(f'echo "$EXTRAS" > /opt/mapless/{IMAGE_EXTRAS}') == 2


def test_the_lock_of_the_pages_is_that_of_their_package() -> None:
    package, lock = json.loads((WEB / "package.json").read_text()), json.loads((WEB / "package-lock.json").read_text())
    root = lock["packages"][""]
    for kind in ("dependencies", "devDependencies"):
        assert root[kind] == package[kind]
    assert root["version"] == lock["version"] == package["version"]
    assert all(it["integrity"].startswith("sha512-") for name, it in lock["packages"].items() if name)
    assert "omit-lockfile-registry-resolved=true" in (WEB / ".npmrc").read_text().splitlines()


def test_nothing_installs_a_package_named_mapless_from_an_index() -> None:
    asked = re.compile(r"""install (?:--?[\w-]+ )*['"]?mapless(?:\[[\w,]*\])?(?=['"`\s=<>~]|$)(?! @)""")
    assert asked.search("pip install 'mapless[networks]'")
    for folder in ("client", "server", "deploy", "docker", "docs", ".ci", "README.md", "CONTRIBUTING.md", "Makefile"):
        top = ROOT / folder
        for path in [top] if top.is_file() else top.rglob("*"):
            if path.suffix in {".py", ".md", ".yaml", ".toml", ".sh", ""} and path.is_file():
                if "node_modules" in path.parts:
                    continue
                assert not asked.search(path.read_text(errors="replace")), path
