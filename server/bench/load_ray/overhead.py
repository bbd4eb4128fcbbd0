"""The cost of the ingress: one replica called through HAProxy and at its own port, and a plain server, by turns."""

import asyncio
from statistics import median

from bench.load import no_op
from bench.load.driving import SCENE, photo_request
from bench.load.overhead import Called, OverheadOptions, Subject, compare_by_turns
from bench.load.report import Check
from bench.search_path import with_search_path
from mapless import Client
from mapless_server.settings import PREFIX
from mapless_tools.child import child_module
from mapless_tools.progress import Progress

from .cluster import application, running_cluster
from .database import VARIABLE, database_url
from .replacing import NO_OP, Scenes

MAX_OVERHEAD_MS = 3.0
THROUGH, DIRECT, PLAIN = "through HAProxy", "replica's own port", "plain server"
WORKERS = 2


OPTIONS = OverheadOptions(rounds=10, saturated_s=2.0)
"""More and shorter rounds than of a server alone: more processes share the cores."""


def measure_overhead(options: OverheadOptions, progress: Progress) -> list[Subject]:
    """Starts a replica with its ingress, and the plain server on the same database, and calls them by turns."""
    photo = no_op.padded_photo(options.message_bytes)
    names = ["r0", "r1"]
    request = photo_request(photo, no_op.CAMERA, names)
    with database_url() as url, running_cluster({VARIABLE: url}) as cluster:
        cluster.deploy(application({"insecure": True, "workers": WORKERS}, 1, import_path=NO_OP))
        environment = with_search_path({VARIABLE: url, f"{PREFIX}WORKERS": str(WORKERS)})
        with child_module("bench.load.no_op", environment=environment) as plain:
            with Client(cluster.address) as client:
                client.create_scene(SCENE)
                client.add_references(SCENE, [Scenes(photo=photo).reference(name) for name in names])
            (replica,) = cluster.replicas()
            places = {
                THROUGH: Called(cluster.address, replica.process_id),
                DIRECT: Called(replica.address, replica.process_id),
                PLAIN: Called(plain.address, plain.process_id),
            }
            return asyncio.run(compare_by_turns(places, request, options, progress))


def overhead_checks(ways: list[Subject]) -> list[Check]:
    """The bar."""
    by_name = {way.name: way.p50s_ms for way in ways}
    rounds = [a - b for a, b in zip(by_name[THROUGH], by_name[DIRECT], strict=True)]
    value = f"{median(rounds):.2f} ms (rounds {min(rounds):.2f} to {max(rounds):.2f})"
    bar, met = f"at most {MAX_OVERHEAD_MS:g} ms", median(rounds) <= MAX_OVERHEAD_MS
    return [Check("p50 overhead of the ingress, one call at a time", value, bar, met)]
