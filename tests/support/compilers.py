"""Compilers for what the protos generate: skipped without them, or required."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest


def needs(*programs: str | Path) -> None:
    """Skips without the programs, or fails where TEST_PROTOC asks for them."""
    missing = [str(it) for it in programs if not (it.exists() if isinstance(it, Path) else shutil.which(it))]
    if missing and os.environ.get("TEST_PROTOC") == "required":
        pytest.fail(f"not installed: {', '.join(missing)}")
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")


def run(*command: str | Path, folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
