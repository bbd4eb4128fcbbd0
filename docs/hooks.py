"""mkdocs hooks: bring in the pages that live beside what they describe, and make links those of the site.

Links are written as they work in the repository; here those that leave `docs/` lead to the page that shows the file, or
become plain text.
"""

import os
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]

OUTSIDE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security-reports.md",
    "client/cpp/README.md": "guides/cpp.md",
    "client/unity/README.md": "guides/unity.md",
    "deploy/envoy/README.md": "operation/envoy.md",
    "deploy/ray/README.md": "operation/ray.md",
    "deploy/ray/kubernetes/README.md": "operation/ray-kubernetes.md",
    "server/research/README.md": "research.md",
}
"""Pages of the site that lie outside docs/, by their path in the repository."""

_LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")
_FENCED = re.compile(r"(^[ ]*```.*?^[ ]*```$)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: Any) -> Files:
    """Adds the pages from outside docs/."""
    for source, page in OUTSIDE.items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Makes links those of the site."""
    return relinked(markdown, page.file.src_uri)


def relinked(markdown: str, page: str) -> str:
    """The text of a page with links of the site instead of the repository's."""
    source = {shown: outside for outside, shown in OUTSIDE.items()}.get(page, f"docs/{page}")

    def link(found: re.Match[str]) -> str:
        text, target, anchor = found[1], found[2], found[3] or ""
        if ":" in target:
            return found[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        shown = OUTSIDE.get(path) or (path.removeprefix("docs/") if path.startswith("docs/") else None)
        if shown is None:
            return text
        return f"[{text}]({os.path.relpath(shown, posixpath.dirname(page) or '.')}{anchor})"

    parts = _FENCED.split(markdown)
    return "".join(part if position % 2 else _LINK.sub(link, part) for position, part in enumerate(parts))
