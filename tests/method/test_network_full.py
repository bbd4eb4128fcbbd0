"""The whole method with a full-size network, once, on the CPU: result and memory."""

import logging
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import resource, sys
sys.path[:0] = sys.argv[1:]
from support.parity_rule import ruled_network
from support.small_networks import photograph, references_of, view_of
from support.images import textured
from mapless_server.method.coarse.network import NetworkReconstructor
from mapless_server.method.coarse import reconstruct_one
from mapless_server.method.views import Reconstruction
from mapless_server.networks.runner import NetworkRunner

backend = NetworkReconstructor(NetworkRunner(ruled_network("pi3", small=False), "pi3", "rule"))
photos = [photograph(textured(640, 480, seed=seed)) for seed in range(2)]
made = reconstruct_one(backend, view_of(photos[0]), references_of(photos[1:]))
assert isinstance(made, Reconstruction), made
print(made.references[0].point_map.shape)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""

log = logging.getLogger(__name__)


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_a_full_network_reconstructs_photographs_within_16_gib() -> None:
    """In a process of its own, whose memory is the network's alone."""
    tests = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(tests)], capture_output=True, text=True, timeout=800)
    assert done.returncode == 0, done.stderr
    shape, peak_kib = done.stdout.splitlines()
    assert shape == "(392, 518, 3)"
    log.warning("peak memory %.1f GiB", int(peak_kib) / 2**20)
    assert int(peak_kib) < 16 * 2**20
