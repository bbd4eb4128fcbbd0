"""A real PostgreSQL for tests, from the system's package: one for each test run, which ends with the run.

Each test gets a schema of its own, which costs milliseconds where a database costs a tenth of a second.
"""

import atexit
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from functools import cache
from itertools import count
from pathlib import Path

import psycopg
import pytest

from bench.load.driving import free_port

USER = "mapless"
START_LIMIT_S = 30.0
_UNPRIVILEGED = ("postgres", "nobody")
_SETTINGS = {
    "listen_addresses": "127.0.0.1",
    "unix_socket_directories": "",
    "max_connections": "60",
    "shared_buffers": "32MB",
    "wal_level": "minimal",
    "max_wal_senders": "0",
    "fsync": "off",  # processes may be killed: what they have written is the kernel's
}


def programs() -> Path | None:
    """Folder of initdb, postgres and the like; None where the package is not installed."""
    on_path = shutil.which("initdb")
    found = [Path(on_path)] if on_path else sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return found[-1].parent if found else None


class Cluster:
    """A running PostgreSQL.

    Args:
        tables_on, log_on: the disks of its files and of its write-ahead log, which all must be able to reach; None for
            the usual place.
    """

    def __init__(self, tables_on: Path | None = None, log_on: Path | None = None) -> None:
        folder = programs()
        assert folder is not None
        self._programs = folder
        # Root may not run it. Its files are then another user's, who must be able to reach them.
        users = [it for it in _UNPRIVILEGED if _has_user(it)] if os.geteuid() == 0 else []
        self._user = pwd.getpwnam(users[0]) if users else None
        self._folder = self._own_folder()
        self._data = self._own_folder(tables_on) / "data"
        log_folder = self._own_folder(log_on) / "log"
        self._folders = (self._folder, self._data.parent, log_folder.parent)
        self.port = free_port()
        self._numbers = count()
        self._settings = _SETTINGS | {"port": str(self.port)}
        self._server: subprocess.Popen[bytes] | None = None
        try:
            who = ("--auth=trust", f"--username={USER}")
            self._run("initdb", *who, "--encoding=UTF8", "--locale=C", "--no-sync", f"--waldir={log_folder}")
            self.start()
        except BaseException:
            self.remove()
            raise

    def fresh_url(self) -> str:
        """URL of an empty schema."""
        schema = f"test_{os.getpid()}_{next(self._numbers)}"
        with self.connect() as connection:
            connection.execute(f"CREATE SCHEMA {schema}")
        return f"postgresql://{USER}@127.0.0.1:{self.port}/postgres?options=-csearch_path%3D{schema}"

    def connect(self) -> psycopg.Connection[tuple[object, ...]]:
        """Past everything of ours; commits by itself."""
        return psycopg.connect(f"postgresql://{USER}@127.0.0.1:{self.port}/postgres", autocommit=True)

    def start(self) -> None:
        """Start it and wait until it accepts connections, after its recovery."""
        settings = [f"--{name}={value}" for name, value in self._settings.items()]
        with (self._folder / "log").open("ab") as log:
            self._server = subprocess.Popen(
                [*self._as_user(), str(self._programs / "postgres"), "-D", str(self._data), *settings],
                stdout=log,
                stderr=log,
                cwd=self._folder,
            )
        give_up = time.monotonic() + START_LIMIT_S
        while not self.lets_in():
            if self._server.poll() is not None or time.monotonic() > give_up:
                raise RuntimeError((self._folder / "log").read_text()[-2000:])
            time.sleep(0.02)

    def stop(self, how: signal.Signals = signal.SIGQUIT) -> None:
        """End it: at once and without tidying up (SIGQUIT, what "immediate" means), or dropping callers (SIGINT)."""
        if self._server is not None:
            self._server.send_signal(how)
            self._server.wait(START_LIMIT_S)
            self._server = None

    def remove(self) -> None:
        """End it and delete its files."""
        self.stop()
        for folder in self._folders:
            shutil.rmtree(folder, ignore_errors=True)

    def lets_in(self) -> bool:
        """Whether it is there and has recovered."""
        try:
            self.connect().close()
        except psycopg.OperationalError:
            return False
        return True

    def _own_folder(self, place: Path | None = None) -> Path:
        folder = Path(tempfile.mkdtemp(prefix="mapless-postgres-", dir=place))
        if self._user is not None:
            os.chown(folder, self._user.pw_uid, self._user.pw_gid)
        return folder

    def _run(self, program: str, *arguments: str) -> None:
        command = [*self._as_user(), str(self._programs / program), "-D", str(self._data), *arguments]
        subprocess.run(command, check=True, capture_output=True, cwd=self._folder, timeout=60)

    def _as_user(self) -> list[str]:
        """The prefix of a command that ends with its parent, even by SIGKILL, and is not root's.

        A program does it, not Popen's `user` and `preexec_fn`: with these Python forks, and gRPC's handlers of a fork
        sometimes abort the child before it becomes the program.
        """
        user = self._user
        of_user = [f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--clear-groups"] if user is not None else []
        return ["setpriv", "--pdeathsig=QUIT", *of_user]


@cache
def shared_cluster() -> Cluster:
    """The one that most tests use; skips the test where there is no PostgreSQL."""
    require()
    cluster = Cluster()
    atexit.register(cluster.remove)
    return cluster


def require() -> None:
    """Skips the test where there is no PostgreSQL; fails it where TEST_POSTGRESQL says that there has to be one."""
    if programs() is None and os.environ.get("TEST_POSTGRESQL") == "required":
        pytest.fail("there is no PostgreSQL: Debian's package `postgresql`")
    if programs() is None:
        pytest.skip("needs PostgreSQL: Debian's package `postgresql`")
    if os.geteuid() == 0 and not any(map(_has_user, _UNPRIVILEGED)):
        pytest.skip("PostgreSQL does not run as root, and there is no other user")


def _has_user(name: str) -> bool:
    try:
        pwd.getpwnam(name)
    except KeyError:
        return False
    return True
