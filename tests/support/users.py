"""The environment of the person who runs the tests, of which they read nothing: settings, weights, proxies."""

import atexit
import os
import shutil
import tempfile

KEPT = "TEST_KEPT_"
"""Begins the names under which proxies and folders are kept, for what fetches from package registries."""

_PROXIES = {f"{scheme}_proxy" for scheme in ("http", "https", "all", "grpc", "no", "no_grpc")}
_FOLDERS = ("XDG_CACHE_HOME", "XDG_CONFIG_HOME")


def leave_the_users_environment() -> None:
    """Removes proxies, folders and all settings of mapless from this process's environment, which others inherit."""
    for name in list(os.environ):
        if name.lower() in _PROXIES or name in _FOLDERS:
            os.environ[KEPT + name] = os.environ.pop(name)
        elif name.startswith("MAPLESS_"):
            del os.environ[name]
    empty = tempfile.mkdtemp(prefix="mapless-tests-")
    atexit.register(shutil.rmtree, empty, ignore_errors=True)
    os.environ |= dict.fromkeys((*_FOLDERS, "MAPLESS_WEIGHTS_DIR"), empty)
    # Servers that tests start as processes begin without the seconds of computing that make first answers fast.
    os.environ["MAPLESS_WARM_UP"] = "false"


def registry_environment() -> dict[str, str]:
    """The environment with the user's proxies and folders, for programs that fetch from package registries."""
    kept = {name.removeprefix(KEPT): value for name, value in os.environ.items() if name.startswith(KEPT)}
    return {name: value for name, value in os.environ.items() if name not in _FOLDERS} | kept
