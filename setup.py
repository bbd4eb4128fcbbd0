"""The compiled module; everything else about the package is in pyproject.toml.

`MAPLESS_PURE=1` builds a wheel for all platforms without it. Where there is no compiler, the package is installed
without it, too: numpy computes the same, in two to three times the time.
"""

import os

from setuptools import Extension, setup

NEAREST = Extension(
    "mapless_server.kernels._nearest",
    ["server/mapless_server/kernels/_nearest.c"],
    define_macros=[("Py_LIMITED_API", "0x030B0000")],
    extra_compile_args=["-O3", "-ffp-contract=off"],
    py_limited_api=True,
    optional=True,
)
IS_PURE = os.environ.get("MAPLESS_PURE") == "1"

setup(
    ext_modules=[] if IS_PURE else [NEAREST],
    options={} if IS_PURE else {"bdist_wheel": {"py_limited_api": "cp311"}},
)
