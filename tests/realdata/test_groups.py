"""Rigs and sequences on real photographs: never worse than single photographs, and found where those are lost."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
from groups import drifting, rescaled

from mapless import (
    Client,
    LocalizationResult,
    NewReference,
    RigidTransform,
    RigImage,
    RigLocalization,
    SequenceFrame,
    SequenceLocalization,
)
from mapless.geometry import Array
from mapless_server.child import child_server
from mapless_server.dataset import Dataset, Frame
from mapless_server.evaluation.run import CONNECT

pytestmark = [pytest.mark.realdata, pytest.mark.slow]

KITCHEN = "7scenes-redkitchen-seq01-first600"
STARTS = (40, 200, 380, 530)
STEP = 8
"""Frames between those of a sequence: a quarter of a second, and 5 to 10 cm."""


@pytest.fixture(scope="module")
def kitchen(
    photographs: Callable[[str], Dataset], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Client, Sequence[Frame]]]:
    """A server with five references of the kitchen, with which one photograph in five is lost, and all frames."""
    frames = photographs(KITCHEN).frames
    used = {start + STEP * i for start in STARTS for i in range(8)}
    far = [i for i in range(len(frames)) if min(abs(i - j) for j in used) > 8]
    chosen = [far[i] for i in np.linspace(0, len(far) - 1, 5).round().astype(int)]
    with child_server(tmp_path_factory.mktemp("kitchen")) as server, Client(server.address, CONNECT) as client:
        client.create_scene("kitchen")
        client.add_references(
            "kitchen",
            [
                NewReference(f"r{i}", frames[i].image_path.read_bytes(), frames[i].camera, frames[i].world_from_camera)
                for i in chosen
            ],
        )
        yield client, frames


def error_m(found: RigidTransform, truth: RigidTransform) -> float:
    difference: Array = found.translation - truth.translation
    return float(np.linalg.norm(difference))


def test_together_they_are_no_worse_than_alone(kitchen: tuple[Client, Sequence[Frame]]) -> None:
    """A rig of three frames with their true extrinsics; eight of a device that loses 2 % of its way, in half metres."""
    client, frames = kitchen
    single: list[float] = []
    rigs: list[float] = []
    sequences: list[float] = []
    photographs = 0
    for start in STARTS:
        walk = [frames[start + STEP * i] for i in range(8)]
        images, truth = [it.image_path.read_bytes() for it in walk], [it.world_from_camera for it in walk]
        for image, frame in zip(images, walk, strict=True):
            photographs += 1
            alone = client.localize(image, frame.camera, "kitchen")
            if isinstance(alone, LocalizationResult):
                single.append(error_m(alone.world_from_camera, frame.world_from_camera))
        fixed = [truth[0].inverse().compose(truth[i]) for i in (0, 3, 6)]
        rig = client.localize_rig(
            [RigImage(images[i], walk[i].camera, pose) for i, pose in zip((0, 3, 6), fixed, strict=True)], "kitchen"
        )
        if isinstance(rig, RigLocalization):
            rigs.append(error_m(rig.world_from_rig, truth[0]))
        session = rescaled(drifting(np.random.default_rng(start), truth, 0.02), 2.0)
        sequence = client.localize_sequence(
            [SequenceFrame(i, f.camera, s) for i, f, s in zip(images, walk, session, strict=True)],
            "kitchen",
            estimate_scale=True,
        )
        if isinstance(sequence, SequenceLocalization):
            sequences.append(error_m(sequence.world_from_camera[-1], truth[-1]))
            assert sequence.world_from_session.scale == pytest.approx(0.5, rel=0.1)
    print(f"single {single}", f"rigs {rigs}", f"sequences {sequences}", sep="\n")
    assert len(rigs) / len(STARTS) >= len(single) / photographs
    assert len(sequences) / len(STARTS) >= len(single) / photographs
    assert np.median(rigs) <= 1.2 * np.median(single)
    assert np.median(sequences) <= np.median(single)
    assert max(sequences) < 0.05
