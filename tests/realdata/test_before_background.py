"""Doubtful photographs that come before the background has made what they need."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from support.images import encode

from mapless import Client, Rejected
from mapless_server.images import ANY_SIZE, decode_image
from mapless_tools.child import CONNECT, child_server
from mapless_tools.dataset import Dataset
from mapless_tools.evaluate.plan import EvaluationOptions, split_frames
from mapless_tools.evaluate.run import SCENE, store_references

pytestmark = [pytest.mark.realdata, pytest.mark.timeout(300)]

KITCHEN, ELSEWHERE = "7scenes-redkitchen-seq01-first600", "office-lockers"
NEEDED = ("edgepoint2-l64", "aliked-n16", "aliked-lightglue")


def test_they_are_answered_in_3_s_and_say_what_was_missing(
    photographs: Callable[[str], Dataset], tmp_path: Path
) -> None:
    """Photographs of another place, and turned by 180 degrees; on a machine that does nothing else."""
    weights = Path(os.environ.get("TEST_WEIGHTS", "nowhere"))
    for name in NEEDED:
        if not (weights / f"{name}.safetensors").is_file():
            pytest.skip(f"needs `mapless-server weights fetch {' '.join(NEEDED)}`; {weights} has no {name}")
    references, queries = split_frames(photographs(KITCHEN).frames, EvaluationOptions(30, 2))
    asked = [(it.image_path.read_bytes(), it.camera) for it in photographs(ELSEWHERE).frames[:2]]
    asked += [
        (encode(".png", decode_image(it.image_path.read_bytes(), ANY_SIZE)[::-1, ::-1]), it.camera) for it in queries
    ]
    settings = {"MAPLESS_FEATURES": "auto", "MAPLESS_WEIGHTS_DIR": str(weights)}
    with child_server(tmp_path, environment=settings) as server, Client(server.address, CONNECT) as client:
        store_references(client, SCENE, references, lambda *_: None)
        for image, camera in asked:
            answer = client.localize(image, camera, scene=SCENE)
            missing = {it.kind for it in answer.diagnostics.missing_evidence}
            assert answer.diagnostics.total_s <= 3
            if isinstance(answer, Rejected):
                assert missing >= {"features", "matches"}
        sure = client.localize(queries[0].image_path.read_bytes(), queries[0].camera, scene=SCENE)
        assert sure.diagnostics.missing_evidence == ()
