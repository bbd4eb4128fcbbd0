"""The program that holds a Ray cluster for its parent process, `cluster`.

It reads JSON objects, one a line, from standard input, and answers each on standard output. It ends with its input.
"""

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

import ray
from ray import serve
from ray.serve._private.client import ServeControllerClient
from ray.serve.context import _get_global_client
from ray.serve.schema import ServeDeploySchema

OBJECT_STORE_BYTES = 100 * 2**20
"""Small, because mapless does not use it."""
APPLICATION = "mapless"
POLL_S = 0.1

Json = dict[str, Any]


@contextmanager
def cluster(options: Json) -> Iterator[ServeControllerClient]:
    """A cluster of this machine alone, with Serve's ingress on loopback."""
    ray.init(
        num_cpus=options["cpus"],
        include_dashboard=False,
        object_store_memory=OBJECT_STORE_BYTES,
        _temp_dir=options["folder"],
        _node_ip_address="127.0.0.1",
        log_to_driver=False,  # it would cost more than the measured calls
    )
    try:
        serve.start(
            proxy_location="HeadOnly",
            http_options={"host": "127.0.0.1", "port": options["http_port"]},
            grpc_options={
                "port": options["grpc_port"],
                "grpc_servicer_functions": ["mapless_ray.ingress:add_services"],
                "enable_reflection": False,
            },
        )
        client = _get_global_client()
        assert client is not None
        yield client
    finally:
        serve.shutdown()  # type: ignore[no-untyped-call]
        ray.shutdown()


def deploy(client: ServeControllerClient, application: Json, limit_s: float) -> Json:
    """Deploys an application, as `serve deploy` does, and waits until it runs as configured."""
    client.deploy_apps(ServeDeploySchema.model_validate({"applications": [application]}))
    give_up_s = time.monotonic() + limit_s
    while True:
        time.sleep(POLL_S)
        found = client.get_serve_details()["applications"][APPLICATION]
        if found["status"] == "RUNNING" and not _is_changing(found):
            return {}
        if found["status"] in ("DEPLOY_FAILED", "UNHEALTHY") or time.monotonic() > give_up_s:
            messages = "; ".join(str(it["message"]) for it in found["deployments"].values())
            return {"error": f"{found['status']}: {found['message']}: {messages}"}


def replicas(client: ServeControllerClient) -> Json:
    """Name, process and port of the gRPC server of all replicas that receive calls."""
    deployments = client.get_serve_details()["applications"][APPLICATION]["deployments"].values()
    processes = {it["actor_name"]: it.get("pid") for deployment in deployments for it in deployment["replicas"]}
    # Serve's details have the ports of the ingress, and its controller those of the replicas.
    groups = ray.get(client._controller.get_target_groups.remote(from_proxy_manager=True))
    targets = [it for group in groups if group.protocol == "gRPC" and group.app_name for it in group.targets]
    found = [
        {"name": it.name.rpartition("#")[2], "process_id": processes[it.name], "port": it.port}
        for it in targets
        if processes.get(it.name)
    ]
    return {"replicas": found}


def _is_changing(application: Json) -> bool:
    return any(
        deployment["status"] != "HEALTHY"
        or any(it["state"] != "RUNNING" for it in deployment["replicas"])
        or len(deployment["replicas"]) != deployment["target_num_replicas"]
        for deployment in application["deployments"].values()
    )


def main() -> None:
    """Holds the cluster until the input ends."""
    answers = _own_output()
    options = json.loads(sys.argv[1])
    with cluster(options) as client:
        _send(answers, {})
        for line in sys.stdin:
            command = json.loads(line)
            if "deploy" in command:
                _send(answers, deploy(client, command["deploy"], command["limit_s"]))
            else:
                _send(answers, replicas(client))


def _own_output() -> TextIO:
    """The standard output for answers; what Ray prints there goes to standard error from now on."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return answers


def _send(answers: TextIO, answer: Json) -> None:
    print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
