"""Servers as processes of their own: the real command, or one whose method the test controls.

Run as a program, this file is the latter: everything is the real thing but the features and the method, which first
appends a line to the file "began" and goes on when there is a file "gate". So tests hold it where they want it.
"""

import asyncio
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

from mapless_server.engine.query import Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.judge.answer import Answer
from mapless_server.method.pipeline import Pipeline
from mapless_server.observability.logs import configure_logging
from mapless_server.observability.metrics import Metrics
from mapless_server.security import RateLimiter
from mapless_server.serve.assembly import Parts, engine_options, engine_over
from mapless_server.serve.run import serve
from mapless_server.settings import Settings, load_settings
from mapless_server.store import Store
from support.servers import StandInExtractor, StandInMethod, StandInReconstructor, whole
from support.waiting import LIMIT_S

TESTS = Path(__file__).parents[1]
GATED = ("-m", "support.programs")
_ANNOUNCEMENT = "mapless-server listening on "


@dataclass
class Program:
    """A server that runs, or begins to.

    Attributes:
        process: the server's.
        folder: of its store, its log and the files that lead it.
    """

    process: subprocess.Popen[str]
    folder: Path

    @property
    def log(self) -> str:
        """The log so far."""
        return (self.folder / "log").read_text()

    @property
    def metrics_address(self) -> str:
        """Where its metrics are, as the log says."""
        found = re.search(r"metrics on http://([^/]+)/metrics", self.log)
        assert found
        return found.group(1)

    @property
    def output(self) -> str:
        """The rest of its output until it ends."""
        assert self.process.stdout is not None
        return self.process.stdout.read()

    @property
    def began(self) -> int:
        """How many calls have come to the method."""
        path = self.folder / "began"
        return len(path.read_text().splitlines()) if path.exists() else 0

    def open_gate(self) -> None:
        """The method goes on."""
        (self.folder / "gate").touch()

    @cached_property
    def address(self) -> str:
        """Where it listens; waits until it does."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith(_ANNOUNCEMENT), self.log
        return line.removeprefix(_ANNOUNCEMENT).strip()

    def wait(self) -> int:
        """Its exit code."""
        return self.process.wait(LIMIT_S)


@contextmanager
def program(
    folder: Path, arguments: Sequence[str], prefix: Sequence[str] = (), cwd: Path | None = None, **environment: str
) -> Iterator[Program]:
    """A Python program, or what runs one, with its log in the folder; it is gone when the block is left."""
    folder.mkdir(exist_ok=True)
    paths = (str(TESTS), os.environ.get("PYTHONPATH"))
    with (folder / "log").open("a") as log:
        process = subprocess.Popen(
            [*prefix, sys.executable, *arguments],
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            cwd=cwd,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **environment},
        )
    deadline = threading.Timer(LIMIT_S, process.kill)  # reading its output has no deadline
    deadline.start()
    try:
        yield Program(process, folder)
    finally:
        deadline.cancel()
        process.kill()
        process.communicate(timeout=LIMIT_S)


def printed(program: str, *arguments: object) -> str:
    """The output of a Python program that ends without an error."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=LIMIT_S, check=True).stdout


@contextmanager
def real(folder: Path, **settings: Any) -> Iterator[Program]:
    """`python -m mapless_server`, at once."""
    given = {"port": 0, "metrics_port": 0, "data_dir": folder / "data", "workers": 2} | settings
    flags = [part for name, value in given.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    with program(folder, ["-m", "mapless_server", "serve", *flags]) as running:
        yield running


@contextmanager
def gated(folder: Path, kind: str = "asks", **settings: Any) -> Iterator[Program]:
    """The program that is this file; its method "asks" whether its job is cancelled, or "hangs" for ever."""
    given = [f"{name}={value}" for name, value in settings.items()]
    with program(folder, [*GATED, str(folder), kind, *given]) as running:
        yield running


def _main(folder: Path, kind: str, given: Sequence[str]) -> None:
    flags: dict[str, Any] = {"port": 0, "data_dir": folder / "data", "metrics": False, "warm_up": False}
    flags |= dict(it.split("=", 1) for it in given)
    settings = load_settings(flags).settings
    configure_logging(settings)
    stand_in = StandInMethod()
    stand_in.gate.set()

    def localize(*arguments: Any) -> Answer:
        *_, check = arguments
        with (folder / "began").open("a") as began:
            began.write("began\n")
        while not (folder / "gate").exists():
            time.sleep(0.005)
            if kind == "asks":
                check()
        return stand_in(*arguments)

    def make(settings: Settings, store: Store, metrics: Metrics, quota: RateLimiter | None) -> QueueEngine:
        tiers = [Tier(StandInExtractor(), Pipeline(cast(Any, StandInReconstructor())))]
        return engine_over(store, tiers, engine_options(settings), Parts(metrics, quota, whole(localize)))

    asyncio.run(serve(settings, make))


if __name__ == "__main__":
    _main(Path(sys.argv[1]), sys.argv[2], sys.argv[3:])
