"""LightGlue on a GPU gives the CPU's matches, also while a network runs."""

import threading
from collections.abc import Callable

import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("kornia", reason="the networks' extra is not installed")

import numpy as np
import torch
from support.scenes import random_for
from support.small_networks import small_network

from mapless_server.networks.lightglue import LightGlue
from mapless_server.networks.runner import NetworkRunner

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]

KEYPOINTS, REFERENCES, WIDTH = 300, 4, 128


def match(device: str, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """Scores of one query with references of different numbers of keypoints, by a random network."""
    torch.manual_seed(0)
    network = LightGlue(WIDTH, layers=3).eval().to(device)
    random = random_for("lightglue cuda")
    position, positions = (random.uniform(-1, 1, (n, KEYPOINTS, 2)) for n in (1, REFERENCES))
    descriptor, descriptors = (random.normal(size=(n, KEYPOINTS, WIDTH)) / np.sqrt(WIDTH) for n in (1, REFERENCES))
    inputs = [torch.from_numpy(array).float().to(device) for array in (position, descriptor, positions, descriptors)]
    counts = torch.tensor([KEYPOINTS, 40, 250, 1], device=device)
    mask = torch.arange(KEYPOINTS, device=device) < counts[:, None]
    with torch.inference_mode(), torch.autocast(device, dtype, enabled=dtype is not torch.float32):
        _, score = network(*inputs, mask)
    assert isinstance(score, torch.Tensor)
    return score.float().cpu()


def test_scores_are_the_cpus() -> None:
    torch.testing.assert_close(match("cuda"), match("cpu"), rtol=0, atol=1e-3)


def test_a_network_running_beside_it_changes_nothing() -> None:
    """Which kernels one of them may take must not decide what the other one may."""
    expected = match("cuda", torch.float16)
    runner = NetworkRunner(small_network("pi3"), "pi3", "sha", "cuda")
    images = torch.rand(4, 3, 56, 70)
    failures: list[BaseException] = []

    def repeatedly(work: Callable[[], object]) -> None:
        try:
            for _ in range(50):
                work()
        except BaseException as error:
            failures.append(error)

    def found() -> None:
        torch.testing.assert_close(match("cuda", torch.float16), expected, rtol=0, atol=1e-2)

    work = (found, lambda: runner.reconstruct(runner.encode(images)[None], (4, 5), 3))
    threads = [threading.Thread(target=repeatedly, args=(each,)) for each in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    runner.close()
    assert failures == []
