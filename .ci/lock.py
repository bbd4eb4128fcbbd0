"""Writes requirements.lock: the version of every package that image, CI and `make setup` install, and no address.

Usage: PYTHON_OF_AN_ENVIRONMENT .ci/lock.py TORCH_VERSION [--upgrade]

Versions alone, no digests: the builds of torch, and what a company's own index builds, have digests of their own.
Torch's local label (+cpu) is left out, and so are the libraries of its CUDA build, which it names exactly itself.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "requirements.lock"
HEADER = """\
# The versions that image, CI and `make setup` install, for Python 3.11 and newer; `make lock` writes them.
# A list of constraints: pip install --constraint requirements.lock '.[server]'
"""
OF_CUDA = re.compile(r"(nvidia-[\w-]+|cuda-[\w-]+|triton)==")


def main() -> None:
    """Resolves the versions, keeping those of the present file unless they are to be upgraded."""
    torch, *options = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        pinned, found = Path(folder) / "pinned.txt", Path(folder) / "found.txt"
        pinned.write_text(f"torch=={torch}\n")
        if LOCK.is_file():
            found.write_text(LOCK.read_text())
        command = [sys.executable, str(ROOT / ".ci" / "uv.py"), "pip", "compile", "pyproject.toml", "--quiet"]
        command += ["--all-extras", "--universal", "--python-version", "3.11", "--no-header", "--no-annotate"]
        command += ["--constraint", str(pinned), "--output-file", str(found), *options]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        lines = [line for line in found.read_text().splitlines() if line and not line.startswith("#")]
    # Where an index has several builds of torch, each has a line, with the platforms that it is for.
    kept = [f"torch=={torch}" if line.startswith("torch==") else line for line in lines if not OF_CUDA.match(line)]
    LOCK.write_text(HEADER + "".join(f"{line}\n" for line in dict.fromkeys(kept)))


main()
