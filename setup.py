"""The compiled modules; everything else about the package is in pyproject.toml.

`MAPLESS_PURE=1` builds a wheel for all platforms without them. Where there is no compiler, the package is installed
without them, too: numpy computes the same, in two to ten times the time. So do Python 3.10, on which the client alone
runs, and free-threaded builds: the modules use the stable interface of 3.11.
"""

import os
import sys
import sysconfig

from setuptools import Extension, setup

KERNELS = [
    Extension(
        f"mapless_server.kernels._{name}",
        [f"server/mapless_server/kernels/_{name}.c"],
        define_macros=[("Py_LIMITED_API", "0x030B0000")],
        extra_compile_args=["-O3", f"-ffp-contract={contracted}"],
        py_limited_api=True,
        optional=True,
    )
    for name, contracted in (("adjustment", "off"), ("edgepoint2", "fast"), ("nearest", "off"))
]
HAS_INTERFACE = sys.version_info >= (3, 11) and not sysconfig.get_config_var("Py_GIL_DISABLED")
IS_PURE = os.environ.get("MAPLESS_PURE") == "1" or not HAS_INTERFACE

setup(
    ext_modules=[] if IS_PURE else KERNELS,
    options={} if IS_PURE else {"bdist_wheel": {"py_limited_api": "cp311"}},
)
