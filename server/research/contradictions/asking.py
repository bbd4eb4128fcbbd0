"""Asks the cases of a server of its own, and says which answers are right."""

import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mapless import Client, LocalizationResult, MaplessError, Rejected, RigidTransform
from mapless_tools.child import CONNECT, ChildServer, child_server
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.output_files import finite
from research.places import Place, distance_seen, is_right

from .cases import Case, Expected

ENVIRONMENT = {"MAPLESS_BACKGROUND_MATCHING": "false"}
"""Work in the background would make answers depend on how long the others took."""
Row = dict[str, Any]


def ask_all(cases: Iterable[Case]) -> Iterator[Row]:
    """Asks each case, one after the other; its place is stored before the first of its cases.

    ServerFailed as of `child_server`, MaplessError if references cannot be stored.
    """
    stored: set[str] = set()
    with _server() as (server, client):
        for case in cases:
            if case.place.scene not in stored:
                store(client, case.place)
                stored.add(case.place.scene)
            yield ask(server, client, case)


@contextmanager
def _server() -> Iterator[tuple[ChildServer, Client]]:
    with (
        tempfile.TemporaryDirectory(prefix="mapless-contradictions-") as folder,
        child_server(Path(folder), environment=ENVIRONMENT) as server,
        Client(server.address, CONNECT) as client,
    ):
        yield server, client


def store(client: Client, place: Place) -> None:
    """Stores a place's references in a new scene; MaplessError if that fails."""
    client.create_scene(place.scene, arbitrary_unit=not place.dataset.metric)
    client.add_references(place.scene, place.references())


def ask(server: ChildServer, client: Client, case: Case) -> Row:
    """A case's answer as JSON has it; a call that fails is an outcome, too. Its place must be stored."""
    row: Row = {"kind": case.kind, "name": case.name, "expected": case.expected.value}
    image = case.image()
    begin_cpu_s, begin_s = processor_s(server), time.perf_counter()
    try:
        answer = client.localize(image, case.camera, case.place.scene, priors=case.priors, include_debug=True)
    except MaplessError as error:
        return row | {"outcome": f"failed: {type(error).__name__}", "message": str(error)}
    finally:
        row["seconds"] = time.perf_counter() - begin_s
        row["processor_s"] = processor_s(server) - begin_cpu_s
    row |= _of_rejection(answer) if isinstance(answer, Rejected) else _of_localization(case, answer)
    diagnostics = answer.diagnostics
    return row | {
        "features": diagnostics.features,
        "retrieval": diagnostics.retrieval,
        "attempts": [asdict(it) for it in getattr(diagnostics, "attempts", ())],
        "references": [asdict(it) for it in diagnostics.references],
    }


def _of_rejection(answer: Rejected) -> Row:
    hypotheses = [
        {"pose": _numbers(it.world_from_camera), "inliers": it.inlier_count, "references": list(it.references)}
        for it in answer.hypotheses
    ]
    return {
        "outcome": answer.reason,
        "message": answer.message,
        "advice": answer.hint.advice if answer.hint else "",
        "hypotheses": hypotheses,
    }


def _of_localization(case: Case, answer: LocalizationResult) -> Row:
    true, pose, debug = case.true_pose, answer.world_from_camera, answer.debug
    errors = pose_error(true, pose) if true is not None else (np.inf, np.inf)
    seen = distance_seen(case.camera, true, debug.x_in_world) if true is not None and debug is not None else 0.0
    has_pose = case.expected not in (Expected.REJECTED, Expected.AMBIGUOUS)
    is_expected = has_pose and is_right(*errors, seen, case.place.dataset.metric)
    accuracy = answer.accuracy
    radii = None
    if accuracy is not None:
        radii = [
            accuracy.position_68_m,
            accuracy.position_95_m,
            accuracy.rotation_68_deg,
            accuracy.rotation_95_deg,
        ]
    return {
        "outcome": "right" if is_expected else "wrong",
        "error": finite(errors[0]),
        "error_deg": finite(errors[1]),
        "distance_seen": seen,
        "pose": _numbers(pose),
        "trust": answer.trust,
        "radii": radii,
        "inliers": answer.inlier_count,
        "matches": answer.match_count,
        "stage": answer.pose_stage,
        "priors": [str(it) for it in answer.prior_checks],
    }


def _numbers(pose: RigidTransform) -> list[float]:
    """Position x y z and quaternion x y z w."""
    q = pose.quaternion()
    return [*pose.translation.tolist(), q.x, q.y, q.z, q.w]


def processor_s(server: ChildServer) -> float:
    """Processor time of the server's process, by the clock that clock_getcpuclockid defines on Linux."""
    return time.clock_gettime((~server.process_id << 3) | 2)
