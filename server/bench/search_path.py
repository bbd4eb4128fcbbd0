"""Where child processes find this package, which is not installed."""

import os
from collections.abc import Mapping
from pathlib import Path

SERVER = Path(__file__).parents[1]


def with_search_path(environment: Mapping[str, str] | None = None) -> dict[str, str]:
    """Variables of a child process that imports `bench`, in whichever folder it runs."""
    given = dict(environment or {})
    others = given.get("PYTHONPATH", os.environ.get("PYTHONPATH", ""))
    return given | {"PYTHONPATH": os.pathsep.join(filter(None, [str(SERVER), others]))}
