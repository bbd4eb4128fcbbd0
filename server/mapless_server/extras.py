"""Which extra of mapless brings a Python package that is missing. Imports nothing."""

from __future__ import annotations

_EXTRA_OF = {
    "huggingface_hub": "networks",
    "kornia": "networks",
    "opentelemetry": "otel",
    "PIL": "networks",
    "safetensors": "networks",
    "torch": "networks",
    "transformers": "superpoint",
    "viser": "view",
}
"""By the name under which a package is imported; what is not here, the server needs always."""


def install_hint(error: ImportError) -> str:
    """What is not there, or too old, and what to run, for the operator."""
    if not error.name:  # a shared library, say: no package of ours brings it
        return str(error)
    package = error.name.partition(".")[0]
    is_absent = isinstance(error, ModuleNotFoundError) and error.name == package
    what = f"the Python package {package} is not installed" if is_absent else str(error)
    return f"{what}: pip install 'mapless[{_EXTRA_OF.get(package, 'server')}]'"
