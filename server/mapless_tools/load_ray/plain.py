"""The plain server that computes nothing, with the database of the environment: what replicas are compared with."""

from __future__ import annotations

import asyncio
import sys
import tempfile

from mapless_server.observability.logs import configure_logging
from mapless_server.serve.run import serve
from mapless_server.settings import load_settings
from mapless_tools.load.no_op import make_no_op_engine

if __name__ == "__main__":
    settings = load_settings({"port": 0, "metrics_port": 0, "warm_up": False, "workers": int(sys.argv[1])}).settings
    with tempfile.TemporaryFile(
        "w", encoding="utf-8"
    ) as stream:  # as much as a server logs by default, not to a terminal
        configure_logging(settings, stream)
        asyncio.run(serve(settings, make_no_op_engine))
