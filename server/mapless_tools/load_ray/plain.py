"""The plain server that computes nothing, on the database of the environment, which replicas are compared with."""

from __future__ import annotations

import asyncio
import os
import sys

from mapless_server.observability.logs import configure_logging
from mapless_server.serve.run import serve
from mapless_server.settings import load_settings
from mapless_tools.load.no_op import make_no_op_engine

if __name__ == "__main__":
    settings = load_settings({"port": 0, "metrics_port": 0, "warm_up": False, "workers": int(sys.argv[1])}).settings
    with open(os.devnull, "w") as stream:  # it logs as much as a server by default
        configure_logging(settings, stream)
        asyncio.run(serve(settings, make_no_op_engine))
