"""The command that installs an extra of mapless where this program runs, by how mapless came here.

No index is asked for a package "mapless": none is published, so a stranger who registered the name would be installed.
"""

import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, distributions
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlsplit

NAME = "mapless"
IMAGE_EXTRAS = "image-extras"
"""File in the environment of an image (docker/Dockerfile) with the extras that it was built with."""
_EXTRA_MARKER = re.compile(r"""\s*(?:\band\s+)?\bextra\s*==\s*['"]([\w.-]+)['"]\s*$""")


def how_to_install(extra: str, prefix: Path | None = None) -> str:
    """A command that works here, or for an image, which cannot be changed, how to build it with the extra.

    The prefix is that of the environment; None for the running program's.
    """
    image = (prefix or Path(sys.prefix)) / IMAGE_EXTRAS
    if image.is_file():
        wanted = ",".join([*image.read_text(encoding="utf-8").strip().split(","), extra])
        return f"build the image with --build-arg EXTRAS={wanted}"
    found = list(distributions(name=NAME))
    # A folder of sources on the path has metadata, too, which does not say where it comes from.
    installed = next((it for it in found if it.read_text("direct_url.json")), found[0] if found else None)
    if installed is None:
        return f"install the extra {extra} of {NAME}"
    source = _source(json.loads(installed.read_text("direct_url.json") or "{}"), extra)
    arguments = source or list(dict.fromkeys(_requirements(installed, extra)))
    return shlex.join([*_install(), *arguments])


def _install() -> list[str]:
    """The command that installs into this environment, as short as it is right."""
    beside = Path(sys.executable).parent
    on_path = shutil.which("pip")
    if on_path is not None and Path(on_path).parent == beside:
        return ["pip", "install"]
    if find_spec("pip") is not None:
        return [sys.executable, "-m", "pip", "install"]
    return ["uv", "pip", "install", "--python", sys.executable]


def _source(direct_url: dict[str, object], extra: str) -> list[str]:
    """Pip's arguments for the place that mapless was installed from (PEP 610); empty where that is unknown or gone."""
    url = str(direct_url.get("url", ""))
    parts = urlsplit(url)
    path = Path(unquote(parts.path))
    if not url or (parts.scheme == "file" and not path.exists()):
        return []
    below = direct_url.get("subdirectory")
    match direct_url:
        case {"dir_info": dict(about)}:
            return [*(["--editable"] if about.get("editable") else []), f"{path}[{extra}]"]
        case {"vcs_info": {"vcs": vcs, "commit_id": commit}}:
            return [f"{NAME}[{extra}] @ {vcs}+{url}@{commit}" + (f"#subdirectory={below}" if below else "")]
    return [f"{NAME}[{extra}] @ {url}"]


def _requirements(installed: Distribution, extra: str) -> Iterator[str]:
    """Requirements of the extra, package by package; extras of mapless in it are resolved."""
    for requirement in installed.requires or ():
        what, _, marker = requirement.partition(";")
        of_extra = _EXTRA_MARKER.search(marker)
        if of_extra is None or of_extra[1] != extra:
            continue
        ours = re.fullmatch(rf"{NAME}\[([\w,.\s-]+)\]", what.strip())
        if ours:
            for part in ours[1].split(","):
                yield from _requirements(installed, part.strip())
            continue
        condition = marker[: of_extra.start()].strip().removeprefix("(").removesuffix(")")
        yield f"{what.strip()}; {condition}" if condition else what.strip()
