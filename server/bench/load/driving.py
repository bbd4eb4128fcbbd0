"""The real server with a scene, serialized requests, and calls: concurrent ones, as fast as possible, or at a rate."""

import itertools
import socket
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mapless import Client, ConnectOptions, wire
from mapless.geometry import Camera
from mapless.names import reference_name, scene_name
from mapless.v1 import localization_service_pb2 as pb
from mapless_tools.child import CONNECT, child_server
from mapless_tools.demo import Photograph, Place
from mapless_tools.progress import Progress

from .calls import CallRecord, Fate, Mix, Requests, Times, plan_calls, poisson_times
from .sender import Target, send_open_loop
from .step import Step, closed_loop_step, run_step
from .watch import ServerUnderLoad, priority_over

SCENE = "load"
METHOD = "/mapless.v1.LocalizationService/Localize"


def store_references(client: Client, references: Sequence[Photograph]) -> None:
    """Creates the scene and stores the references in it."""
    client.create_scene(SCENE)
    client.add_references(SCENE, [it.reference() for it in references])


def requests_for(client: Client, queries: Sequence[Photograph]) -> Requests:
    """Requests that name the references which the server would choose, as robots know them, and bad ones."""
    good = []
    for query in queries:
        uses = client.localize(query.data, query.camera, SCENE).diagnostics.references
        good.append(photo_request(query.data, query.camera, [use.name.rpartition("/")[2] for use in uses]))
    first = queries[0]
    bad_images = [b"this is not a photograph", first.data[: len(first.data) // 2]]
    return Requests(good, [photo_request(image, first.camera, ()) for image in bad_images])


def mixed_requests(named: Requests, queries: Sequence[Photograph]) -> Requests:
    """Makes all kinds of good requests: with names, without names, and some that the server can only reject."""
    chosen = [photo_request(query.data, query.camera, ()) for query in queries]
    camera = queries[0].camera
    blank = np.full((camera.height_px, camera.width_px, 3), 127, np.uint8)
    (noise,) = noise_photographs(camera, 1)
    rejected = [photo_request(it, camera, ()) for it in (bytes(cv2.imencode(".jpg", blank)[1]), noise)]
    return Requests([*named.good, *chosen, *rejected], named.bad)


def noise_photographs(camera: Camera, count: int) -> list[bytes]:
    """JPEG files of noise of a camera's size: features everywhere, no match."""
    random, made = np.random.default_rng(0), []
    for _ in range(count):
        coarse = random.integers(0, 256, (camera.height_px // 8, camera.width_px // 8, 3)).astype(np.uint8)
        noise = cv2.resize(coarse, (camera.width_px, camera.height_px), interpolation=cv2.INTER_CUBIC)
        made.append(bytes(cv2.imencode(".jpg", noise)[1]))
    return made


def photo_request(image: bytes, camera: Camera, references: Sequence[str]) -> bytes:
    """A request with a photograph and the ids of references."""
    return bytes(
        pb.LocalizeRequest(
            scene=scene_name(SCENE),
            references=[reference_name(SCENE, reference) for reference in references],
            image=image,
            intrinsics=wire.camera_to_message(camera),
        ).SerializeToString()
    )


def read_answer(data: bytes) -> str:
    """Outcome of an answer: "localized", "coarse" for a pose without time to refine it, or "rejected" and why."""
    answer = pb.LocalizeResponse.FromString(data)
    if answer.WhichOneof("outcome") == "rejection":
        reasons: wire.ProtoEnum = pb.RejectionReason
        return f"rejected {reasons.Name(answer.rejection.reason).removeprefix(wire.enum_prefix(reasons))}"
    return "coarse" if answer.localization.pose_stage == pb.POSE_STAGE_COARSE else "localized"


_RAMP_GAIN = 1.03
"""Twice as many calls side by side give so much more, or the server is saturated."""


@dataclass(frozen=True)
class LoadedServer:
    """The address of a server with a scene; its process, metrics and store; and serialized requests to it."""

    address: str
    under_load: ServerUnderLoad
    requests: Requests


@contextmanager
def server_with_scene(
    place: Place,
    progress: Progress,
    environment: Mapping[str, str] | None = None,
    log: Path | None = None,
    connect: ConnectOptions = CONNECT,
) -> Iterator[LoadedServer]:
    """Starts a server, stores the references of a place, and has it answer every query once.

    It uses the settings of the environment, to which `environment` is added. Its log is appended to the file `log`.
    References are stored with the token of `connect`.
    """
    port = free_port()
    with tempfile.TemporaryDirectory(prefix="mapless-load-") as data_dir:
        flags = {"--metrics-port": str(port), "--metrics-host": "127.0.0.1"}
        with child_server(Path(data_dir), flags, environment, log) as server:
            with Client(server.address, connect) as client:
                progress("storing references", 0, len(place.references))
                store_references(client, place.references)
                progress("first answers", 0, len(place.queries))
                requests = requests_for(client, place.queries)
            with priority_over(server.process_id):
                under_load = ServerUnderLoad(server.process_id, f"127.0.0.1:{port}", Path(data_dir))
                yield LoadedServer(server.address, under_load, requests)


def free_port() -> int:
    """A port of the loopback interface that is free now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


async def find_saturation(
    server: LoadedServer, target: Target, seconds: float, progress: Progress
) -> tuple[list[Step], float]:
    """Increases the number of concurrent calls until the rate stops to grow; also returns the largest rate."""
    steps: list[Step] = []
    best_per_s = 0.0
    for power in itertools.count(1):
        concurrency = 2**power
        progress(f"saturation, {concurrency} calls side by side", 0, 1)
        name, requests = f"{concurrency} at a time", server.requests.good
        step = await closed_loop_step(name, server.under_load, target, requests, concurrency, seconds)
        steps.append(step)
        per_s = step.account.completed_per_s
        if per_s < _RAMP_GAIN * best_per_s or step.account.count(Fate.REFUSED) or step.answers == 0:
            best_per_s = max(best_per_s, per_s)
            break
        best_per_s = per_s
    if best_per_s == 0:
        raise RuntimeError(f"the server answered nothing: {dict(steps[-1].account.outcomes)}")
    return steps, best_per_s


async def open_step(
    name: str,
    server: LoadedServer,
    target: Target,
    rate_per_s: float,
    seconds: float,
    *,
    settle_s: float,
    seed: int,
    mix: Mix | None = None,
    requests: Requests | None = None,
    beside: Callable[[], AbstractAsyncContextManager[object]] = nullcontext,
    times: Times = poisson_times,
) -> Step:
    """Runs a step of arrivals that no answer influences; the requests are the server's or others."""
    asked = requests or server.requests
    plan = plan_calls(rate_per_s, seconds, len(target.methods), asked, mix or Mix(), seed, times)

    async def send() -> list[CallRecord]:
        async with beside():
            return await send_open_loop(target, plan)

    return await run_step(name, server.under_load, send, seconds, asked_per_s=rate_per_s, settle_s=settle_s)
