"""A warm query: both servers have the same references, and localize each photograph by turns."""

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np

from mapless import Client, LocalizationResult, PosePrior, Priors
from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_tools.child import ChildServer
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.run import SCENE, store_references

from .comparison import TURNS, Figure
from .servers import connected, processor_s, wait_until_idle


@dataclass(frozen=True)
class Measured:
    """The cost of one photograph: (2, T) processor time of each commit's server and time that the client measures.

    `apart_m` is the distance between the two commits' positions; None if one has no position.
    """

    processor_s: Array
    wall_s: Array
    apart_m: float | None


def measure(
    servers: Sequence[ChildServer], references: Sequence[Frame], queries: Sequence[Frame], rounds: int, tracking: bool
) -> list[Measured]:
    """Localizes photographs on two servers by turns, after once each on both; the servers choose the references.

    It begins when both are idle after the import.
    """
    with ExitStack() as stack:
        clients = [stack.enter_context(connected(server)) for server in servers]
        for client in clients:
            store_references(client, SCENE, references, lambda *_: None)
        if not wait_until_idle(servers):
            print("The servers were not idle after the import: it costs queries processor time.", file=sys.stderr)
        measured = []
        random = np.random.default_rng(0)
        for frame in queries:
            priors = Priors(pose=_prior_of(frame, random)) if tracking else None
            pairs = zip(clients, servers, strict=True)
            positions = [localized(client, server, frame, priors)[2] for client, server in pairs]
            found: list[list[tuple[float, float]]] = [[], []]
            for side in TURNS * rounds:
                found[side].append(localized(clients[side], servers[side], frame, priors)[:2])
            times = np.moveaxis(np.array(found), 2, 0)
            both = [it for it in positions if it is not None]
            apart_m = float(np.linalg.norm(both[0] - both[1])) if len(both) == 2 else None
            measured.append(Measured(times[0], times[1], apart_m))
    return measured


def figures_of(measured: Sequence[Measured]) -> list[Figure]:
    """Processor time and time of a call, of each photograph the mean over the turns."""
    return [
        Figure("warm query, processor time", "ms", _means_ms([it.processor_s for it in measured])),
        Figure("warm query, time of a call", "ms", _means_ms([it.wall_s for it in measured])),
    ]


def agreement(measured: Sequence[Measured]) -> str:
    """How many photographs both localized, and how far their positions are apart."""
    apart = [it.apart_m for it in measured if it.apart_m is not None]
    most = f", at most {max(apart):.2g} (unit of the scene) apart" if apart else ""
    return f"Localized by both: {len(apart)}{most}."


def _means_ms(times_s: Sequence[Array]) -> Array:
    return np.asarray(1e3 * np.array(times_s).mean(axis=2))


def _prior_of(frame: Frame, random: np.random.Generator) -> PosePrior:
    """The true pose, off by random errors of the stated standard deviations."""
    sigmas = np.repeat([0.05, np.radians(2.0)], 3)
    shift, turn = (sigmas * random.standard_normal(6)).reshape(2, 3)
    true = frame.world_from_camera
    pose = RigidTransform(rotation_from_vector(turn) @ true.rotation, true.translation + shift)
    return PosePrior(pose, np.diag(sigmas**2))


def localized(
    client: Client, server: ChildServer, frame: Frame, priors: Priors | None = None
) -> tuple[float, float, Array | None]:
    """Localizes a photograph; returns processor time of the server and time of the call, seconds, and the position."""
    image = frame.image_path.read_bytes()
    begin_cpu_s, begin_s = processor_s(server.process_id), perf_counter()
    answer = client.localize(image, frame.camera, SCENE, priors=priors, mask=frame.mask_path)
    wall_s, cpu_s = perf_counter() - begin_s, processor_s(server.process_id) - begin_cpu_s
    position = answer.world_from_camera.translation if isinstance(answer, LocalizationResult) else None
    return cpu_s, wall_s, position


def resized(frames: Sequence[Frame], width_px: int, folder: Path) -> tuple[Frame, ...]:
    """The photographs at another width, written to a folder as JPEGs; masks and depths are left out."""
    found = []
    for frame in frames:
        size = width_px, round(width_px * frame.camera.height_px / frame.camera.width_px)
        pixels = cv2.imread(str(frame.image_path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        assert pixels is not None, frame.image_path
        path = folder / f"{frame.name}.jpg"
        cv2.imwrite(str(path), cv2.resize(pixels, size, interpolation=cv2.INTER_CUBIC))
        camera = frame.camera.resized(*size)
        found.append(replace(frame, image_path=path, camera=camera, mask_path=None, depth=None))
    return tuple(found)
