"""A PostgreSQL for a measurement: that of the environment, or a temporary one from the system's package."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bench.load.driving import free_port
from mapless_server.settings import PREFIX

VARIABLE = f"{PREFIX}DATABASE_URL"
START_LIMIT_S = 30.0


class NoDatabase(Exception):
    """There is no PostgreSQL; the message says what is missing."""


@contextmanager
def database_url() -> Iterator[str]:
    """The URL in MAPLESS_DATABASE_URL; else that of an empty database on loopback, deleted when the block is left."""
    if VARIABLE in os.environ:
        yield os.environ[VARIABLE]
        return
    programs = sorted(Path("/usr/lib/postgresql").glob("*/bin"))
    if not programs:
        raise NoDatabase(f"set {VARIABLE}, or install PostgreSQL")
    with tempfile.TemporaryDirectory(prefix="mapless-postgres-") as folder, _running(programs[-1], Path(folder)) as url:
        yield url


@contextmanager
def _running(programs: Path, folder: Path) -> Iterator[str]:
    user: dict[str, Any] = {}
    if os.geteuid() == 0:  # which PostgreSQL does not run as
        account = pwd.getpwnam("postgres")
        shutil.chown(folder, account.pw_uid, account.pw_gid)
        user = {"user": account.pw_uid, "group": account.pw_gid, "extra_groups": []}
    data, port = folder / "data", free_port()
    options = ["--auth=trust", "--username=mapless", "--encoding=UTF8", "--locale=C"]
    subprocess.run(
        [programs / "initdb", "-D", data, *options], check=True, stdout=subprocess.DEVNULL, cwd=folder, **user
    )
    options = ["-c", "listen_addresses=127.0.0.1", "-c", f"port={port}", "-c", "unix_socket_directories="]
    with (folder / "log").open("wb") as log:
        server = subprocess.Popen(
            [programs / "postgres", "-D", data, *options], stdout=log, stderr=log, cwd=folder, **user
        )
    try:
        is_ready: list[str | Path] = [programs / "pg_isready", "--quiet", "--host=127.0.0.1", f"--port={port}"]
        give_up_s = time.monotonic() + START_LIMIT_S
        while subprocess.run(is_ready, check=False).returncode:
            if time.monotonic() > give_up_s:
                raise NoDatabase((folder / "log").read_text()[-2000:])
            time.sleep(0.1)
        yield f"postgresql://mapless@127.0.0.1:{port}/postgres"
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(START_LIMIT_S)
