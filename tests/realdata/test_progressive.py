"""Accuracy of coarse and refined answers on photographs with known poses, by the shipped server."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mapless import Client, LocalizationResult, NewReference
from mapless_tools.child import child_server
from mapless_tools.dataset import Dataset


@pytest.mark.nightly
def test_the_coarse_pose_is_near_the_refined_and_a_little_worse(
    photographs: Callable[[str], Dataset], tmp_path: Path
) -> None:
    """And another place's photograph has none: the geometric backend finds no pose to be refined."""
    fountain, church = photographs("fountain-P11"), photographs("herz-jesus-P8")
    errors_m: dict[bool, list[float]] = {False: [], True: []}
    with child_server(tmp_path, {"--workers": "1"}) as server, Client(server.address) as client:
        client.create_scene("fountain")
        client.add_references(
            "fountain",
            [NewReference(it.name, it.image_path, it.camera, it.world_from_camera) for it in fountain.frames],
        )
        for frame in fountain.frames[::5]:
            others = [it.name for it in fountain.frames if it is not frame]
            answers = list(client.localize_progressively(frame.image_path, frame.camera, "fountain", others))
            assert [it.is_final for it in answers] == [False, True]
            for answer in answers:
                assert isinstance(answer, LocalizationResult)
                error = answer.world_from_camera.translation - frame.world_from_camera.translation
                errors_m[answer.is_final].append(float(np.linalg.norm(error)))
        other = church.frames[0]
        (only,) = client.localize_progressively(other.image_path, other.camera, "fountain")
    assert not isinstance(only, LocalizationResult)
    assert max(errors_m[False]) < 0.02
    assert np.median(errors_m[True]) < 0.005
