"""Servers of a commit, and the processor time that they use."""

import compileall
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from mapless import Client
from mapless_tools.child import CONNECT, ChildServer, child_server
from mapless_tools.usage import UsageError

NO_BACKGROUND = {"MAPLESS_BACKGROUND_MATCHING": "false"}
_IDLE_SHARE = 0.05
"""A server that uses less of a core is idle."""
_QUIET_S = 3.0
_LONGEST_WAIT_S = 120.0


@dataclass(frozen=True)
class Side:
    """A commit that is compared: its files, and a folder of its own for stores."""

    commit: str
    tree: Path
    folder: Path

    @contextmanager
    def server(
        self, store: str, features: str | None = None, background: bool = False, port: int = 0
    ) -> Iterator[ChildServer]:
        """Runs a server on a store of that name; features None are those of the environment, port 0 is any."""
        environment = {"PYTHONPATH": f"{self.tree / 'client'}:{self.tree / 'server'}", "PYTHONDONTWRITEBYTECODE": ""}
        environment |= {} if background else NO_BACKGROUND
        environment |= {} if features is None else {"MAPLESS_FEATURES": features}
        with child_server(self.folder / store, {"--port": str(port)}, environment) as server:
            yield server


@contextmanager
def sides(before: str, after: str) -> Iterator[tuple[Side, Side]]:
    """Both commits' files, compiled; an empty name is the working tree. UsageError for an unknown commit."""
    with tempfile.TemporaryDirectory(prefix="mapless-turns-") as folder, ExitStack() as stack:
        found = []
        for number, commit in enumerate((before, after)):
            own = Path(folder) / str(number)
            own.mkdir()
            found.append(Side(commit, stack.enter_context(_tree(commit, own / "tree")), own))
        yield found[0], found[1]


@contextmanager
def _tree(commit: str, tree: Path) -> Iterator[Path]:
    if not commit:
        yield Path.cwd()
        return
    if subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), commit], check=False).returncode:
        raise UsageError(f"git has no commit {commit!r} here")
    try:
        if (tree / "setup.py").exists():
            subprocess.run([sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"], cwd=tree, check=True)
        compileall.compile_dir(tree / "client", quiet=1)
        compileall.compile_dir(tree / "server", quiet=1)
        yield tree
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", str(tree)], check=False)


@contextmanager
def connected(server: ChildServer) -> Iterator[Client]:
    """A client that has called the server once."""
    with Client(server.address, CONNECT) as client:
        client.is_serving()
        yield client


def processor_s(process_id: int) -> float:
    """Processor time of another process, to the nanosecond, by the clock that clock_getcpuclockid defines on Linux."""
    return time.clock_gettime((~process_id << 3) | 2)


def wait_until_idle(servers: Sequence[ChildServer]) -> bool:
    """Waits until all servers have been idle for 3 s, at most 120 s; returns whether they have.

    After an import a server goes on: it loads stronger features, and calibrates.
    """
    begin_s = quiet_since_s = time.monotonic()
    used_s = [processor_s(it.process_id) for it in servers]
    while (now_s := time.monotonic()) - quiet_since_s < _QUIET_S:
        if now_s - begin_s > _LONGEST_WAIT_S:
            return False
        time.sleep(0.5)
        last_s, used_s = used_s, [processor_s(it.process_id) for it in servers]
        spent_s = max(after - before for before, after in zip(last_s, used_s, strict=True))
        if spent_s > _IDLE_SHARE * (time.monotonic() - now_s):
            quiet_since_s = time.monotonic()
    return True
