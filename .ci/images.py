"""Pins images by digest for a release, and refuses to build one where an image has none.

Usage: python .ci/images.py pin REGISTRY [IMAGE...]   writes name:tag@sha256:... for all, or the given, images
       python .ci/images.py check                     exit code 1, and the images without a digest
       python .ci/images.py build TARGET TAG          docker build, if version and base are those of a release

Images whose names have no host are asked for at REGISTRY, "host[:port]": where they are published, or a mirror. A host
on the loopback interface is asked by HTTP, any other by HTTPS; only registries that answer without sign-in.
"""

import json
import re
import subprocess
import sys
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

ROOT = Path.cwd()
BASE = ROOT / "docker" / "Dockerfile"
LINE = re.compile(
    r"^(?P<before>\s*(?:- )?image: |ARG PYTHON_IMAGE=)(?P<name>[\w./:-]+?:[\w.-]+)(?P<digest>@sha256:[0-9a-f]{64})?$",
    re.MULTILINE,
)
ACCEPTED = (
    "application/vnd.oci.image.index.v1+json, application/vnd.docker.distribution.manifest.list.v2+json, "
    "application/vnd.oci.image.manifest.v1+json, application/vnd.docker.distribution.manifest.v2+json"
)
KUSTOMIZED = re.compile(
    r"^(?P<before> *- name: (?P<name>\S+)\n +newTag: (?P<tag>\S+)\n)(?P<digest> +digest: sha256:[0-9a-f]{64}\n)?",
    re.MULTILINE,
)
"""A tag that an overlay sets in place of the base's, whose digest goes with it."""
LIMIT_S = 30.0


def files() -> Iterator[Path]:
    """All files that name images."""
    yield BASE
    yield from sorted((ROOT / "deploy").rglob("*.yaml"))


def unpinned(paths: list[Path]) -> list[str]:
    """The images without a digest, with their files."""
    faults = []
    for path in paths:
        text = path.read_text()
        named = [(it["name"], it["digest"]) for it in LINE.finditer(text)]
        named += [(f"{it['name']}:{it['tag']}", it["digest"]) for it in KUSTOMIZED.finditer(text)]
        faults += [f"{path.relative_to(ROOT)}: {image}" for image, digest in named if not digest]
    return faults


def digest_of(image: str, registry: str) -> str:
    """The digest that a registry has for name:tag; the program ends if it has none."""
    name, _, tag = image.rpartition(":")
    first, _, rest = name.partition("/")
    if "." in first or ":" in first:
        registry, name = first, rest
    elif not rest:
        name = f"library/{name}"
    scheme = "http" if registry.partition(":")[0] in {"localhost", "127.0.0.1"} else "https"
    url = f"{scheme}://{registry}/v2/{name}/manifests/{tag}"
    try:
        with asked(url) as answer:
            digest = str(answer.headers.get("Docker-Content-Digest", ""))
    except OSError as error:
        sys.exit(f"images: {image} at {registry}: {error}")
    if not re.fullmatch(r"sha256:[0-9a-f]{64}", digest):
        sys.exit(f"images: {registry} gives no digest of {image}")
    return digest


def asked(url: str) -> "urllib.request._UrlopenRet":
    """The answer to a question for a manifest; with a token of the registry, where it asks for one."""
    request = urllib.request.Request(url, method="HEAD", headers={"Accept": ACCEPTED})
    try:
        return urllib.request.urlopen(request, timeout=LIMIT_S)
    except urllib.error.HTTPError as error:
        if error.code != 401:
            raise
        parts = dict(re.findall(r'(\w+)="([^"]*)"', error.headers.get("WWW-Authenticate", "")))
    query = urllib.parse.urlencode({key: parts[key] for key in ("service", "scope") if key in parts})
    with urllib.request.urlopen(f"{parts.get('realm', '')}?{query}", timeout=LIMIT_S) as answer:
        request.add_header("Authorization", f"Bearer {json.load(answer)['token']}")
    return urllib.request.urlopen(request, timeout=LIMIT_S)


def pin(registry: str, only: list[str]) -> None:
    """Writes the digests of today."""
    digests: dict[str, str] = {}

    def digest(image: str) -> str:
        if image not in digests:
            digests[image] = digest_of(image, registry)
            print(f"{image}@{digests[image]}")
        return digests[image]

    def pinned(found: "re.Match[str]") -> str:
        image = found["name"]
        return found[0] if only and image not in only else f"{found['before']}{image}@{digest(image)}"

    def kustomized(found: "re.Match[str]") -> str:
        image = f"{found['name']}:{found['tag']}"
        return found[0] if only and image not in only else f"{found['before']}    digest: {digest(image)}\n"

    # All are found before any is written.
    texts = {path: KUSTOMIZED.sub(kustomized, LINE.sub(pinned, path.read_text())) for path in files()}
    for path, text in texts.items():
        if text != path.read_text():
            path.write_text(text)


def refuse(faults: list[str]) -> None:
    """Ends the program if there is a fault."""
    if faults:
        sys.exit("images: no digest, which `make release-images REGISTRY=...` writes:\n" + "\n".join(faults))


def build(target: str, tag: str) -> None:
    """Builds an image for a release."""
    (version,) = re.findall(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    if "dev" in version:
        sys.exit(f"images: {version} is no release")
    refuse(unpinned([BASE]))
    revision = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    labels = ("--build-arg", f"VERSION={version}", "--build-arg", f"REVISION={revision or 'unknown'}")
    command = ["docker", "build", "-f", str(BASE.relative_to(ROOT)), "--target", target, *labels, "-t", tag, "."]
    sys.exit(subprocess.run(command, cwd=ROOT, check=False).returncode)


def main() -> None:
    """Runs one of the commands."""
    match sys.argv[1:]:
        case ["pin", registry, *images] if registry:
            pin(registry, images)
        case ["check"]:
            refuse(unpinned(list(files())))
        case ["build", target, tag]:
            build(target, tag)
        case _:
            sys.exit(__doc__)


main()
