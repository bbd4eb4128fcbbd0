"""Two commits compared in one run, by turns: `python -m bench.turns BEFORE [AFTER] --data FOLDER`.

Times of two runs differ by more than a change of the code does, so a server of each commit is measured at the same
time: both have the same references, and localize each photograph one after the other, in the order A B B A. What is
compared is processor time, which other programs on the machine change least; ratios are geometric means over the
photographs, with 95 % intervals by bootstrap over these.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mapless import Client, LocalizationResult, PosePrior, Priors
from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.serve.signals import terminable
from mapless_tools.child import CONNECT, ChildServer, child_server
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.evaluate.plan import EvaluationOptions, split_frames
from mapless_tools.evaluate.run import SCENE, store_references
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.output_files import markdown_table
from mapless_tools.usage import UsageError, failures_end_command, usage_errors

TURNS = (0, 1, 1, 0)
RESAMPLES = 2000


@dataclass(frozen=True)
class Measured:
    """The cost of one photograph: (2, T) processor time of each commit's server and time that the client measures.

    `apart_m` is the distance between the two commits' positions; None if one has no position.
    """

    processor_s: Array
    wall_s: Array
    apart_m: float | None


def main(
    before: Annotated[str, typer.Argument(help="A commit, in the repository of the current folder.")],
    after: Annotated[str, typer.Argument(help="Another one; default: the working tree.")] = "",
    data: Annotated[Path, typer.Option(help="Folder with photographs and poses.")] = Path("../shared/data"),
    scene: Annotated[str, typer.Option(help="Folder in it.")] = "7scenes-redkitchen-seq01-first600",
    references: Annotated[int, typer.Option(min=2, help="Photographs that are stored.")] = 30,
    photographs: Annotated[int, typer.Option(min=2, help="Photographs that are localized.")] = 20,
    rounds: Annotated[int, typer.Option(min=1, help="Times that each is localized A B B A.")] = 1,
    tracking: Annotated[
        bool, typer.Option(help="With a pose prior, off by 5 cm and 2 degrees about each axis.")
    ] = False,
) -> None:
    """Compare what a warm query costs two commits; settings are those of the environment (MAPLESS_...)."""
    with failures_end_command():
        with usage_errors():
            if not before:
                raise UsageError("no commit to compare with was given: make bench-turns BEFORE=commit")
            dataset = read_folder(data / scene)
        with terminable(), ExitStack() as stack:
            servers = [stack.enter_context(_server(commit)) for commit in (before, after)]
            measured = measure(servers, dataset, EvaluationOptions(references, photographs), rounds, tracking)
        print("\n".join(report(measured, (before, after or "working tree"))))


@contextmanager
def _server(commit: str) -> Iterator[ChildServer]:
    """Runs a server of a commit, or of the working tree if it is empty, without work in the background."""
    environment = {"MAPLESS_BACKGROUND_MATCHING": "false"}
    with tempfile.TemporaryDirectory(prefix="mapless-turns-") as folder, ExitStack() as stack:
        tree = Path.cwd()
        if commit:
            tree = Path(folder) / "tree"
            added = subprocess.run(["git", "worktree", "add", "--quiet", "--detach", str(tree), commit], check=False)
            if added.returncode:
                raise UsageError(f"git has no commit {commit!r} here")
            stack.callback(subprocess.run, ["git", "worktree", "remove", "--force", str(tree)], check=False)
            if (tree / "setup.py").exists():
                subprocess.run([sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"], cwd=tree, check=True)
        environment["PYTHONPATH"] = f"{tree / 'client'}:{tree / 'server'}"
        with child_server(Path(folder) / "data", environment=environment) as server:
            yield server


def measure(
    servers: Sequence[ChildServer], dataset: Dataset, options: EvaluationOptions, rounds: int, tracking: bool = False
) -> list[Measured]:
    """Localizes photographs on two servers by turns, after once each on both; the servers choose the references."""
    references, queries = split_frames(dataset.frames, options)
    with ExitStack() as stack:
        clients = [stack.enter_context(Client(server.address, CONNECT)) for server in servers]
        for client in clients:
            store_references(client, SCENE, references, lambda *_: None)
        measured = []
        random = np.random.default_rng(0)
        for frame in queries:
            priors = Priors(pose=_prior_of(frame, random)) if tracking else None
            sides = zip(clients, servers, strict=True)
            positions = [_call(client, server, frame, priors)[2] for client, server in sides]
            found: list[list[tuple[float, float]]] = [[], []]
            for side in TURNS * rounds:
                found[side].append(_call(clients[side], servers[side], frame, priors)[:2])
            times = np.moveaxis(np.array(found), 2, 0)
            both = [it for it in positions if it is not None]
            apart_m = float(np.linalg.norm(both[0] - both[1])) if len(both) == 2 else None
            measured.append(Measured(times[0], times[1], apart_m))
    return measured


def _prior_of(frame: Frame, random: np.random.Generator) -> PosePrior:
    """The true pose, off by random errors of the stated standard deviations."""
    sigmas = np.repeat([0.05, np.radians(2.0)], 3)
    shift, turn = (sigmas * random.standard_normal(6)).reshape(2, 3)
    true = frame.world_from_camera
    pose = RigidTransform(rotation_from_vector(turn) @ true.rotation, true.translation + shift)
    return PosePrior(pose, np.diag(sigmas**2))


def _call(
    client: Client, server: ChildServer, frame: Frame, priors: Priors | None
) -> tuple[float, float, Array | None]:
    image = frame.image_path.read_bytes()
    begin_cpu_s, begin_s = _processor_s(server.process_id), time.perf_counter()
    answer = client.localize(image, frame.camera, SCENE, priors=priors, mask=frame.mask_path)
    wall_s, cpu_s = time.perf_counter() - begin_s, _processor_s(server.process_id) - begin_cpu_s
    position = answer.world_from_camera.translation if isinstance(answer, LocalizationResult) else None
    return cpu_s, wall_s, position


def _processor_s(process_id: int) -> float:
    """Processor time of another process, to the nanosecond, by the clock that clock_getcpuclockid defines on Linux."""
    return time.clock_gettime((~process_id << 3) | 2)


def report(measured: Sequence[Measured], names: tuple[str, str]) -> list[str]:
    """Lines of the report, in Markdown."""
    lines = [f"{len(measured)} photographs, {names[0]} and {names[1]} by turns (A B B A), medians in ms.", ""]
    rows = []
    for what, times in {
        "processor time": np.array([it.processor_s for it in measured]),
        "time of a call": np.array([it.wall_s for it in measured]),
    }.items():
        a, b = 1e3 * np.median(times, axis=(0, 2))
        ratio, low, high = ratio_with_interval(times.mean(axis=2))
        rows.append((what, f"{a:.1f}", f"{b:.1f}", f"{ratio:.3f}", f"{low:.3f} to {high:.3f}"))
    apart = [it.apart_m for it in measured if it.apart_m is not None]
    most = f", at most {max(apart):.2g} (unit of the scene) apart" if apart else ""
    table = markdown_table(" | before | after | ratio | 95 %", rows)
    return [*lines, *table, "", f"Localized by both: {len(apart)}{most}."]


def ratio_with_interval(times: Array) -> tuple[float, float, float]:
    """Geometric mean of after / before of times (N, 2), with its 95 % interval by bootstrap over the rows."""
    logs = np.log(times[:, 1] / times[:, 0])
    drawn = np.random.default_rng(0).integers(len(logs), size=(RESAMPLES, len(logs)))
    low, high = np.quantile(logs[drawn].mean(axis=1), [0.025, 0.975])
    return float(np.exp(logs.mean())), float(np.exp(low)), float(np.exp(high))


if __name__ == "__main__":
    typer.run(main)
