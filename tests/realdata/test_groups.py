"""Rigs and sequences on real photographs: no worse than single photographs, and localized where those are not."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
from support.groups import drifting, rescaled

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
from mapless_tools.child import CONNECT, child_server
from mapless_tools.dataset import Dataset, Frame

pytestmark = [pytest.mark.realdata, pytest.mark.nightly("groups")]

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


def walk_of(frames: Sequence[Frame], start: int) -> tuple[list[Frame], list[bytes], list[RigidTransform]]:
    """Eight frames, their photographs and true poses."""
    walk = [frames[start + STEP * i] for i in range(8)]
    return walk, [it.image_path.read_bytes() for it in walk], [it.world_from_camera for it in walk]


@pytest.mark.parametrize("start", STARTS)
def test_a_sequence_is_no_worse_than_its_photographs(kitchen: tuple[Client, Sequence[Frame]], start: int) -> None:
    """Poses of a device that loses 2 % of its way, in half metres. Photographs lost alone count as infinitely wrong."""
    client, frames = kitchen
    walk, images, truth = walk_of(frames, start)
    alone = [client.localize(image, frame.camera, "kitchen") for image, frame in zip(images, walk, strict=True)]
    errors_m = [
        error_m(it.world_from_camera, pose) if isinstance(it, LocalizationResult) else np.inf
        for it, pose in zip(alone, truth, strict=True)
    ]
    session = rescaled(drifting(np.random.default_rng(start), truth, 0.02), 2.0)
    together = client.localize_sequence(
        [SequenceFrame(i, f.camera, s) for i, f, s in zip(images, walk, session, strict=True)],
        "kitchen",
        estimate_session_scale=True,
    )
    assert isinstance(together, SequenceLocalization), together
    found_m = [error_m(*it) for it in zip(together.world_from_camera, truth, strict=True)]
    assert np.median(found_m) <= 1.2 * min(np.median(errors_m), 0.05)
    assert found_m[-1] <= together.accuracy.position_95_m
    assert together.world_from_session.scale == pytest.approx(0.5, abs=3 * together.scale_sigma)


@pytest.mark.parametrize("start", STARTS)
def test_a_rig_of_three_frames(kitchen: tuple[Client, Sequence[Frame]], start: int) -> None:
    """With their true extrinsics; its error is what it claims, also where no photograph is localized alone."""
    client, frames = kitchen
    walk, images, truth = walk_of(frames, start)
    rig = [RigImage(images[i], walk[i].camera, truth[0].inverse().compose(truth[i])) for i in (0, 3, 6)]
    found = client.localize_rig(rig, "kitchen")
    assert isinstance(found, RigLocalization), found
    found_m = error_m(found.world_from_rig, truth[0])
    assert found_m < 0.1
    assert found_m <= 1.5 * found.accuracy.position_95_m
