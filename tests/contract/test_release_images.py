"""At a release images are pinned by what a registry says, and nothing is built on a base without a digest."""

import hashlib
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import cast

import pytest
import yaml  # type: ignore[import-untyped]
from support.manifests import KUBECTL, needs_kubectl

ROOT = Path(__file__).parents[2]
PROGRAM = ROOT / ".ci" / "images.py"
BASE = "library/python"


def digest_of(name: str, tag: str) -> str:
    return f"sha256:{hashlib.sha256(f'{name}:{tag}'.encode()).hexdigest()}"


class Registry(BaseHTTPRequestHandler):
    """A registry that has everything, but hands out a token first."""

    absent = ""

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b'{"token": "one-day"}')

    def do_HEAD(self) -> None:
        _, _, path = self.path.partition("/v2/")
        name, _, tag = path.partition("/manifests/")
        is_known = self.headers.get("Authorization") == "Bearer one-day"
        code = 401 if not is_known else 404 if name == self.absent else 200
        self.send_response(code)
        if code == 401:
            _, port = cast("tuple[str, int]", self.server.server_address)
            realm = f"http://127.0.0.1:{port}/token"
            self.send_header(
                "WWW-Authenticate", f'Bearer realm="{realm}",service="test",scope="repository:{name}:pull"'
            )
        elif code == 200:
            self.send_header("Docker-Content-Digest", digest_of(name, tag))
        self.end_headers()


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Registry) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        yield f"127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join(30)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of what names images, as of a release."""
    for name in ("deploy", "docker"):
        shutil.copytree(ROOT / name, tmp_path / name)
    (tmp_path / "pyproject.toml").write_text('version = "9.9.9"\n')
    return tmp_path


def run(checkout: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    environment = {"PATH": f"{checkout / 'bin'}{os.pathsep}{os.environ['PATH']}"}
    command = [sys.executable, str(PROGRAM), *arguments]
    return subprocess.run(command, cwd=checkout, capture_output=True, text=True, env=environment, timeout=60)


def with_docker(checkout: Path) -> Path:
    """A program "docker" that notes what it is asked for."""
    program, noted = checkout / "bin" / "docker", checkout / "asked"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\necho "$@" > {noted}\n')
    program.chmod(0o755)
    return noted


def test_every_image_gets_the_digest_of_the_registry(checkout: Path, registry: str) -> None:
    before = run(checkout, "check")
    assert before.returncode == 1
    assert {"docker/Dockerfile: python:3.12.13-slim-trixie"} <= set(before.stderr.splitlines())
    assert run(checkout, "pin", registry).returncode == 0
    after = run(checkout, "check")
    assert (after.returncode, after.stderr) == (0, "")
    pinned = f"ARG PYTHON_IMAGE=python:3.12.13-slim-trixie@{digest_of(BASE, '3.12.13-slim-trixie')}\n"
    assert pinned in (checkout / "docker" / "Dockerfile").read_text()
    assert run(checkout, "pin", registry).returncode == 0  # again: the same
    assert pinned in (checkout / "docker" / "Dockerfile").read_text()


@needs_kubectl
def test_what_kustomize_makes_is_pinned_with_the_overlays_tag(checkout: Path, registry: str) -> None:
    assert run(checkout, "pin", registry).returncode == 0
    for overlay in ("cpu", "cuda"):
        command = [str(KUBECTL), "kustomize", str(checkout / "deploy" / "kubernetes" / "overlays" / overlay)]
        made = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
        (image,) = {
            container["image"]
            for document in yaml.safe_load_all(made)
            if document["kind"] == "StatefulSet"
            for container in document["spec"]["template"]["spec"]["containers"]
        }
        name, _, digest = image.partition("@")
        tag = name.partition(":")[2]
        assert digest in {digest_of("library/mapless", tag), *_digests(overlay)}
        assert not tag or tag.endswith(overlay)


def _digests(overlay: str) -> set[str]:
    lines = (ROOT / "deploy" / "kubernetes" / "overlays" / overlay / "kustomization.yaml").read_text().splitlines()
    return {digest_of("library/mapless", line.split()[-1]) for line in lines if "newTag:" in line}


def test_only_the_images_asked_for_are_pinned(checkout: Path, registry: str) -> None:
    assert run(checkout, "pin", registry, "python:3.12.13-slim-trixie").returncode == 0
    assert "@sha256:" in (checkout / "docker" / "Dockerfile").read_text()
    assert "@sha256:" not in (checkout / "deploy" / "compose.yaml").read_text()


def test_an_image_that_is_absent_leaves_all_as_it_was(
    checkout: Path, registry: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Registry, "absent", "grafana/grafana")
    ended = run(checkout, "pin", registry)
    assert ended.returncode == 1
    assert "grafana/grafana" in ended.stderr
    assert "@sha256:" not in (checkout / "docker" / "Dockerfile").read_text()


def test_a_release_is_not_built_on_a_base_without_digest(checkout: Path, registry: str) -> None:
    asked = with_docker(checkout)
    refused = run(checkout, "build", "cpu", "mapless:x")
    assert refused.returncode == 1
    assert "docker/Dockerfile: python:3.12.13-slim-trixie" in refused.stderr
    assert not asked.exists()
    assert run(checkout, "pin", registry).returncode == 0
    assert run(checkout, "build", "cpu", "mapless:x").returncode == 0
    assert "--target cpu --build-arg VERSION=9.9.9" in asked.read_text()


def test_a_development_version_is_not_built_as_a_release(checkout: Path, registry: str) -> None:
    asked = with_docker(checkout)
    assert run(checkout, "pin", registry).returncode == 0
    (checkout / "pyproject.toml").write_text('version = "9.9.9.dev0"\n')
    refused = run(checkout, "build", "cpu", "mapless:x")
    assert (refused.returncode, refused.stderr) == (1, "images: 9.9.9.dev0 is no release\n")
    assert not asked.exists()
