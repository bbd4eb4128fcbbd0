"""The stages on a CUDA device give the host's results without synchronization."""

from __future__ import annotations

from dataclasses import replace

import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")

import torch
from support.device import CASES, VARIANTS, Case, assert_same

from mapless_server.method.on_device import Refined, prepare
from mapless_server.method.on_device.compute import Options, compute
from mapless_server.method.on_device.transfer import upload
from mapless_server.method.scale_equations import ScaleOptions

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


def on_cuda(case: Case) -> Case:
    there = case.reconstruction
    return replace(
        case,
        reconstruction=replace(
            there,
            point_maps=there.point_maps.cuda(),
            confidence=there.confidence.cuda(),
            local_from_camera=there.local_from_camera.cuda(),
        ),
    )


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("case", CASES)
def test_every_variant_equals_the_hosts_result(case: str, variant: str) -> None:
    options = (ScaleOptions(), *VARIANTS[variant])
    assert_same(on_cuda(CASES[case]).on_device(*options), CASES[case].on_host(*options))


@pytest.mark.parametrize("variant", VARIANTS)
def test_nothing_synchronizes_between_the_network_and_the_fetch(variant: str) -> None:
    case, options = on_cuda(CASES["noise"]), Options(ScaleOptions(), *VARIANTS[variant])
    scene, there = case.scene, case.reconstruction
    torch.cuda.set_sync_debug_mode("error")
    try:
        job = prepare(there.reference_cameras, scene.query, scene.references, case.correspondences, options)
        outputs = compute(there, upload(job.inputs, torch.device("cuda")), scene.query.camera, options)
        with pytest.raises(RuntimeError, match="synchroniz"):
            outputs.broken_pixels.item()
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_the_same_query_has_the_same_answer_bit_for_bit() -> None:
    case = on_cuda(CASES["noise"])
    answers = [case.on_device(ScaleOptions(), *VARIANTS["best"]) for _ in range(2)]
    points = [answer.structure for answer in answers if isinstance(answer, Refined)]
    assert len(points) == 2
    assert points[0] is not None
    assert points[1] is not None
    assert points[0].x_in_world.tobytes() == points[1].x_in_world.tobytes()
