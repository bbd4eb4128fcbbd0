"""Writes what an image contains as a CycloneDX document, build/mapless-VERSION.cdx.json, without any registry's host.

Usage: PYTHON_OF_AN_ENVIRONMENT .ci/sbom.py VERSION ENVIRONMENT_TO_DESCRIBE

The environment is one with the packages of an image. Packages are named by purl, name and version; addresses of files
and indexes, which say where this machine got them, are left out.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def main() -> None:
    """Describes the environment."""
    version, environment = sys.argv[1:]
    program = Path(sys.executable).parent / "cyclonedx-py"
    options = ("--pyproject", "pyproject.toml", "--output-reproducible", "--short-PURLs", "--spec-version", "1.6")
    options += ("--no-validate",)  # which takes minutes
    made = subprocess.run(
        [program, "environment", *options, environment], cwd=ROOT, check=True, capture_output=True, text=True
    )
    document = without_addresses(json.loads(made.stdout))
    path = ROOT / "build" / f"mapless-{version}.cdx.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(document, indent=1) + "\n")
    print(f"{path.relative_to(ROOT)}: {len(document['components'])} packages")


def without_addresses(part: Any) -> Any:
    """A part of the document without its external references."""
    if isinstance(part, dict):
        return {name: without_addresses(it) for name, it in part.items() if name != "externalReferences"}
    return [without_addresses(it) for it in part] if isinstance(part, list) else part


main()
