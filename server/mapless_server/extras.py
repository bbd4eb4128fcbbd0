"""Finds which extra of mapless installs a missing Python package. Imports no package."""

from importlib.util import find_spec

from mapless_command.installation import how_to_install

_EXTRA_OF = {
    "av": "reconstruct",
    "huggingface_hub": "networks",
    "jinja2": "tools",
    "kornia": "networks",
    "matplotlib": "tools",
    "OpenEXR": "tools",
    "onnx": "edgepoint2",
    "onnxruntime": "edgepoint2",
    "opentelemetry": "otel",
    "pillow_heif": "reconstruct",
    "pycolmap": "reconstruct",
    "python_multipart": "gateway",
    "rosbags": "tools",
    "starlette": "gateway",
    "torch": "networks",
    "transformers": "superpoint",
    "uvicorn": "gateway",
    "viser": "view",
}
"""By the name under which a package is imported; all others belong to `server`."""


def install_hint(error: ImportError) -> str:
    """The missing or outdated package and how to install it, for the operator."""
    if not error.name:  # such as a shared library, which no extra brings
        return str(error)
    package = error.name.partition(".")[0]
    is_absent = isinstance(error, ModuleNotFoundError) and error.name == package
    what = f"the Python package {package} is not installed" if is_absent else str(error)
    return f"{what}: {how_to_install(_EXTRA_OF.get(package, 'server'))}"


def missing_package(extra: str) -> str:
    """The first package of an extra that is not installed; empty if all are. Imports none of them."""
    return next((package for package, it in _EXTRA_OF.items() if it == extra and find_spec(package) is None), "")
