"""The compiled module; everything else about the package is in pyproject.toml.

`MAPLESS_PURE=1` builds a wheel for all platforms without it. Where there is no compiler, the package is installed
without it, too: numpy computes the same, in two to three times the time. So do Python 3.10, on which the client alone
runs, and free-threaded builds: the module uses the stable interface of 3.11.
"""

import os
import sys
import sysconfig

from setuptools import Extension, setup

NEAREST = Extension(
    "mapless_server.kernels._nearest",
    ["server/mapless_server/kernels/_nearest.c"],
    define_macros=[("Py_LIMITED_API", "0x030B0000")],
    extra_compile_args=["-O3", "-ffp-contract=off"],
    py_limited_api=True,
    optional=True,
)
HAS_INTERFACE = sys.version_info >= (3, 11) and not sysconfig.get_config_var("Py_GIL_DISABLED")
IS_PURE = os.environ.get("MAPLESS_PURE") == "1" or not HAS_INTERFACE

setup(
    ext_modules=[] if IS_PURE else [NEAREST],
    options={} if IS_PURE else {"bdist_wheel": {"py_limited_api": "cp311"}},
)
