"""A hint names an extra that exists and brings the package."""

import sys
from pathlib import Path

import pytest

from mapless_server import extras
from mapless_server.extras import install_hint

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = Path(__file__).parents[2] / "pyproject.toml"
DISTRIBUTION_OF = {"PIL": "pillow", "opentelemetry": "opentelemetry-sdk", "python_multipart": "python-multipart"}


def test_every_extra_brings_its_packages() -> None:
    brought = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for package, extra in extras._EXTRA_OF.items():
        distribution = DISTRIBUTION_OF.get(package, package)
        assert any(requirement.startswith(f"{distribution}>=") for requirement in brought[extra]), package


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        (
            ModuleNotFoundError("No module named 'transformers'", name="transformers"),
            "the Python package transformers is not installed: pip install 'mapless[superpoint]'",
        ),
        (
            ModuleNotFoundError("No module named 'kornia.feature.xfeat'", name="kornia.feature.xfeat"),
            "No module named 'kornia.feature.xfeat': pip install 'mapless[networks]'",
        ),
        (
            ModuleNotFoundError("No module named 'scipy'", name="scipy"),
            "the Python package scipy is not installed: pip install 'mapless[server]'",
        ),
        (ImportError("libGL.so.1: cannot open"), "libGL.so.1: cannot open"),
    ],
)
def test_a_hint_names_the_fault_and_the_command(error: ImportError, hint: str) -> None:
    assert install_hint(error) == hint
