"""Commit of the checkout and name of the processor, for records of answers and measurements."""

import hashlib
import platform
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[3]
"""The checkout, where the package is run from one."""
CODE = ("server", "client")
"""The folders of a checkout on which answers depend."""


def cpu_model() -> str:
    """The processor's name as the system reports it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def commit_of(root: Path) -> str:
    """`git describe` of a checkout, "e18f3fc-dirty.1a2b3c4d" with a digest of changes; empty without git."""
    if not (root / ".git").exists():
        return ""
    try:
        described = _git(root, "describe", "--always", "--tags").strip()
        untracked = _git(root, "ls-files", "--others", "--exclude-standard", "-z", "--", *CODE).split("\0")
        changes = _git(root, "diff", "HEAD", "--", *CODE)
    except (OSError, subprocess.SubprocessError):
        return ""
    digest = hashlib.sha256(changes.encode())
    for name in filter(None, untracked):
        digest.update(name.encode() + (root / name).read_bytes())
    return described if not changes and not any(untracked) else f"{described}-dirty.{digest.hexdigest()[:8]}"


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, errors="replace", timeout=30).stdout
