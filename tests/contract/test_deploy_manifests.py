"""The manifests as kustomize builds them: valid, confined, connected with one another, and with settings of the server.

Envoy's own configuration is checked by Envoy in tests/service/test_envoy.py; here, that it fits the manifests.
"""

import json
import logging
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate  # type: ignore[import-untyped]
import pytest
import yaml  # type: ignore[import-untyped]
from support.manifests import DEPLOY, Json, Pod, built, needs_kubectl, of_kind, pods

from mapless_server.choices import AUTO, BEST_VARIANTS
from mapless_server.networks.weights.catalogue import CATALOGUE
from mapless_server.security import assess_binding
from mapless_server.serve.run import CLOSING_LIMIT_S, NOTIFY_S
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.settings import PREFIX, Settings, load_settings

TARGETS = {
    "kubernetes/base": "cpu",
    "kubernetes/overlays/cpu": "cpu",
    "kubernetes/overlays/cuda": "cuda",
    "kubernetes/overlays/shared": "cpu",
    "kubernetes/overlays/cuda+postgres+autoscaling": "cuda",
    "kubernetes/weights": "cpu",
    "envoy": "cpu",
    "ray/kubernetes": "ray",
}
"""The target of the Dockerfile that each build uses."""
OPEN = ("kubernetes/base", "envoy", "ray/kubernetes")
"""Builds whose servers leave encryption to what is in front of them."""
VERSIONS = ("1.31", kubernetes_validate.latest_version())
"""The oldest and the newest Kubernetes that the manifests are checked against."""
DATABASE = "postgresql://mapless:secret@database.example:5432/mapless?sslrootcert=/etc/mapless/database/ca.crt"
RAYS_PORTS = (8080, 8265, 9101)
"""Metrics of Ray and of HAProxy, and Ray's dashboard."""
CONFINED = {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}}
CONFIG = yaml.safe_load((DEPLOY / "envoy" / "gateway" / "envoy.yaml").read_text())["static_resources"]

pytestmark = needs_kubectl
each_build = pytest.mark.parametrize("build", TARGETS)


def default(setting: str) -> Any:
    return Settings.model_fields[setting].default


def servers(build: str) -> list[Pod]:
    """The pods that serve calls."""
    return [
        it for it in pods(built(build)) if any(var["name"].startswith(PREFIX) for var in it.container.get("env", ()))
    ]


def values_of(pod: Pod) -> dict[str, str]:
    """The server's variables, with what an operator puts into the secrets and Kubernetes fills in."""
    filled = {"secretKeyRef": DATABASE, "resourceFieldRef": pod.container["resources"]["limits"]["cpu"]}
    values = {"MAPLESS_HOST": "0.0.0.0", "MAPLESS_METRICS_HOST": "0.0.0.0"}  # the image's
    for variable in pod.container["env"]:
        (source,) = variable.get("valueFrom", {"value": None})
        values[variable["name"]] = filled[source] if source in filled else variable["value"]
    return {name: value for name, value in values.items() if name.startswith(PREFIX)}


def test_what_is_built_is_valid() -> None:
    """Each document once, though several builds have it."""
    every = [document for build in TARGETS for document in built(build)]
    by_kuberay = [it.template for build in TARGETS for it in pods(built(build)) if it.kind == "RayService"]
    checked = [it for it in every if it["kind"] != "RayService"]
    checked += [
        {"apiVersion": "v1", "kind": "Pod", **it, "metadata": {"name": "ray", **it["metadata"]}} for it in by_kuberay
    ]
    for document in {json.dumps(it): it for it in checked}.values():
        for version in VERSIONS:
            kubernetes_validate.validate(document, version, strict=True)
    assert not [it for it in every if it["kind"] == "Secret"]
    assert {it["metadata"]["namespace"] for it in every if it["kind"] != "Namespace"} == {"mapless"}


@each_build
def test_pods_have_no_rights_and_write_to_volumes_alone(build: str) -> None:
    for pod in pods(built(build)):
        needs_kubernetes = pod.container["name"] == "ray-head"  # the autoscaler beside it
        ids = dict.fromkeys(("runAsUser", "runAsGroup", "fsGroup"), 10001)
        wanted = {"runAsNonRoot": True, "seccompProfile": {"type": "RuntimeDefault"}} | ids
        assert wanted.items() <= pod.spec["securityContext"].items()
        assert pod.container["securityContext"] == CONFINED
        assert pod.spec["enableServiceLinks"] is False
        assert pod.spec.get("automountServiceAccountToken", True) is needs_kubernetes
        assert {"cpu", "memory"} <= set(pod.container["resources"]["requests"])
        assert "memory" in pod.container["resources"]["limits"]
        writable = {it["mountPath"] for it in pod.container["volumeMounts"] if not it.get("readOnly")}
        kept = {"StatefulSet": {"/data"}, "Job": {"/weights"}, "RayService": {"/dev/shm"}}.get(pod.kind, set())
        is_envoy = pod.container["name"] == "envoy"
        assert writable == (set() if is_envoy else kept | {"/cache", "/tmp"})
        image = r"envoyproxy/envoy:v\d+\.\d+\.\d+" if is_envoy else rf"mapless:[\w.]+-{TARGETS[build]}"
        assert re.fullmatch(image, pod.container["image"])


def selections(documents: tuple[Json, ...]) -> Iterator[tuple[dict[str, str], list[Any]]]:
    """Labels by which pods are selected, and ports that they must have."""
    for document in of_kind(documents, "Service"):
        yield document["spec"]["selector"], [it["targetPort"] for it in document["spec"]["ports"]]
    for document in of_kind(documents, "StatefulSet", "Deployment", "PodDisruptionBudget"):
        yield document["spec"]["selector"]["matchLabels"], []
    for document in of_kind(documents, "NetworkPolicy"):
        policy = document["spec"]
        assert policy["policyTypes"] == ["Ingress", "Egress"]
        asked = [it["port"] for rule in policy["ingress"] for it in rule.get("ports", ())]
        yield policy["podSelector"]["matchLabels"], [it for it in asked if it not in RAYS_PORTS]
        for rule in policy["egress"]:
            for peer in rule.get("to", ()):
                if set(peer) == {"podSelector"}:
                    yield peer["podSelector"]["matchLabels"], [it["port"] for it in rule.get("ports", ())]
    for pod in pods(documents):
        for constraint in pod.spec.get("topologySpreadConstraints", ()):
            yield constraint["labelSelector"]["matchLabels"], []


@each_build
def test_selectors_select_pods_that_have_the_ports(build: str) -> None:
    documents = built(build)
    for labels, wanted in selections(documents):
        selected = [pod for pod in pods(documents) if labels.items() <= pod.labels.items()]
        assert selected, labels
        assert set(wanted) <= {*selected[-1].ports, *selected[-1].ports.values()}, labels  # Ray's last take calls
    for pod in pods(documents):
        probes = [probe for name, probe in pod.container.items() if name.endswith("Probe")]
        asked = {action["port"] for probe in probes for action in probe.values() if isinstance(action, dict)}
        assert asked <= {*pod.ports, *pod.ports.values()}
    for document in of_kind(documents, "StatefulSet"):
        assert document["spec"]["replicas"] == 1  # a store of its own has one server
        (governing,) = [it for it in of_kind(documents, "Service") if it["spec"].get("clusterIP") == "None"]
        assert document["spec"]["serviceName"] == governing["metadata"]["name"]


@each_build
def test_what_is_mounted_exists(build: str) -> None:
    documents = built(build)
    page = (DEPLOY.parent / "docs" / "operation" / "deployment.md").read_text() + "".join(
        it.read_text() for it in DEPLOY.rglob("README.md")
    )
    known = {it["metadata"]["name"] for it in (*documents, *built("kubernetes/weights"))}
    for pod in pods(documents):
        assert {it["name"] for it in pod.container["volumeMounts"]} == {*pod.claims, *volumes_of(pod)}
        for volume in volumes_of(pod).values():
            assert "emptyDir" in volume or (
                volume["secret"]["secretName"] in page
                if "secret" in volume
                else volume.get("configMap", {}).get("name", volume.get("persistentVolumeClaim", {}).get("claimName"))
                in known
            )


def volumes_of(pod: Pod) -> dict[str, Json]:
    return {it["name"]: it for it in pod.spec["volumes"]}


@each_build
def test_the_server_takes_its_environment(build: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for pod in servers(build):
        values, container = values_of(pod), pod.container
        for name, value in values.items():
            monkeypatch.setenv(name, value)
        settings = load_settings({}).settings  # an unknown name or a wrong value raises
        assert sorted(pod.ports.values()) == sorted([settings.port, settings.metrics_port])
        assert pod.template["metadata"]["annotations"]["prometheus.io/port"] == str(settings.metrics_port)
        assert assess_binding(settings)[0] == (logging.WARNING if build in OPEN else logging.INFO)
        # On Ray one more, for what Ray itself computes in the pod.
        assert settings.workers == int(container["resources"]["limits"]["cpu"]) - (pod.kind == "RayService")
        ending_s = settings.drain_delay_s + settings.drain_grace_s + CLOSING_LIMIT_S + NOTIFY_S
        assert pod.spec["terminationGracePeriodSeconds"] > ending_s
        secret = {name for name, it in volumes_of(pod).items() if "secret" in it}
        folders = {it["mountPath"] for it in container["volumeMounts"] if it["name"] in secret}
        files = re.findall(r"(?:^|sslrootcert=)(/etc/.*)", "\n".join(values.values()), re.MULTILINE)
        assert {str(Path(it).parent) for it in files} == folders
        assert (settings.database_url is None) is (pod.kind == "StatefulSet")
        mounted = {it["mountPath"]: it.get("readOnly") for it in container["volumeMounts"]}
        is_auto = values.get("MAPLESS_FEATURES") == AUTO or pod.kind == "RayService"  # there by Serve
        assert mounted.get("/weights") is (True if is_auto else None)


@each_build
def test_probes_ask_for_health_and_give_time_to_start(build: str) -> None:
    health = {"grpc": {"port": default("port"), "service": SERVICE_NAMES[0]}}
    if build not in OPEN:  # Kubernetes does not speak TLS there
        health = {"httpGet": {"port": "metrics", "path": "/ready"}}
    for pod in servers(build):
        assert health.items() <= pod.container["readinessProbe"].items()
        if pod.kind != "RayService":  # KubeRay has the others
            starting = pod.container["startupProbe"]
            assert health.items() <= starting.items()
            assert starting["periodSeconds"] * starting["failureThreshold"] >= 300
            assert pod.container["livenessProbe"]["httpGet"] == {"port": "metrics", "path": "/live"}  # never by health


@pytest.mark.parametrize("build", ["kubernetes/base", "envoy", "ray/kubernetes"])
def test_servers_are_reached_only_by_whom_they_are_for(build: str) -> None:
    """Metrics by Prometheus, Ray's dashboard by its operator, calls by pods that are named; from outside only calls."""
    for rule in (rule for it in of_kind(built(build), "NetworkPolicy") for rule in it["spec"]["ingress"]):
        ports = {it["port"] for it in rule.get("ports", ())}
        places = [it.get("namespaceSelector", {}).get("matchLabels", {}) for it in rule.get("from", ())]
        names = [it.get("kubernetes.io/metadata.name") for it in places]
        if ports & {"metrics", "status", default("metrics_port")}:
            assert names == ["monitoring"]
        elif 8265 in ports:
            assert names == ["kuberay-system"]
        else:
            assert all(kind["matchLabels"] for peer in rule.get("from", ()) for kind in peer.values())
            assert rule.get("from") or build != "kubernetes/base"  # else a gateway's, or Ray's among one another
    assert {port["port"] for it in of_kind(built(build), "Service") for port in it["spec"]["ports"]} == {
        default("port")
    }


@pytest.mark.parametrize("build", ["kubernetes/overlays/shared", "envoy", "ray/kubernetes"])
def test_a_database_is_let_through_where_there_is_one(build: str) -> None:
    def ports(build: str) -> set[int]:
        policies = [it["spec"] for it in of_kind(built(build), "NetworkPolicy")]
        return {port["port"] for policy in policies for rule in policy["egress"] for port in rule.get("ports", ())}

    assert 5432 in ports(build)
    assert 5432 not in ports("kubernetes/overlays/cpu")


def test_scaling_needs_a_shared_store_and_a_metric_of_the_adapter() -> None:
    with pytest.raises(subprocess.CalledProcessError):
        built("kubernetes/overlays/cpu+autoscaling")
    documents = built("kubernetes/overlays/cuda+postgres+autoscaling")
    (scaled,), (scaler,) = of_kind(documents, "Deployment"), of_kind(documents, "HorizontalPodAutoscaler")
    assert "replicas" not in scaled["spec"]
    target = scaler["spec"]["scaleTargetRef"]
    assert target == {"apiVersion": "apps/v1", "kind": "Deployment", "name": scaled["metadata"]["name"]}
    (budget,) = of_kind(documents, "PodDisruptionBudget")
    assert scaler["spec"]["minReplicas"] > budget["spec"]["maxUnavailable"]
    (metric,) = scaler["spec"]["metrics"]
    (rule,) = yaml.safe_load((DEPLOY / "prometheus/adapter-rules.yaml").read_text())["rules"]
    assert metric["pods"]["metric"]["name"] == rule["name"]["as"]
    # A full queue is about half of what is admitted; the target must be well below, or nothing would ever be scaled.
    assert float(metric["pods"]["target"]["averageValue"]) / 4 <= default("max_queued_s") / 4


def test_weights_are_permissive_and_all_that_auto_uses() -> None:
    (job,) = pods(built("kubernetes/weights"))
    command, action, *names = job.container["args"]
    assert (command, action) == ("weights", "fetch")
    assert {BEST_VARIANTS["edgepoint2"], "aliked", "aliked-lightglue"} <= set(names)
    catalogue = {weights.name: weights for weights in CATALOGUE}
    assert not any(catalogue[name].licence.restriction for name in names)
    # It needs the internet, so the servers' policy must not be for it.
    (policy,) = of_kind(built("kubernetes/base"), "NetworkPolicy")
    assert not policy["spec"]["podSelector"]["matchLabels"].items() <= job.labels.items()


def test_kustomizations_name_every_file() -> None:
    for kustomization in DEPLOY.rglob("kustomization.yaml"):
        text = kustomization.read_text()
        assert [it.name for it in kustomization.parent.glob("*.yaml") if it.name not in text] == [kustomization.name]


@pytest.mark.parametrize("build", ["envoy", "ray/kubernetes"])
def test_envoy_finds_the_servers_and_its_own_files(build: str) -> None:
    documents = built(build)
    headless = [it for it in of_kind(documents, "Service") if it["spec"].get("clusterIP") == "None"]
    headless += [it["spec"]["serveService"] for it in of_kind(documents, "RayService")]
    servers_at = {"address": headless[0]["metadata"]["name"], "port_value": headless[0]["spec"]["ports"][0]["port"]}
    for cluster in CONFIG["clusters"][:2]:
        (group,) = cluster["load_assignment"]["endpoints"]
        assert [it["endpoint"]["address"]["socket_address"] for it in group["lb_endpoints"]] == [servers_at]
    (gateway,) = [it for it in pods(documents) if it.container["name"] == "envoy"]
    listeners = {it["name"]: it["address"]["socket_address"]["port_value"] for it in CONFIG["listeners"]}
    assert gateway.ports == {"grpc": listeners["calls"], "status": listeners["status"]}
    assert gateway.template["metadata"]["annotations"]["prometheus.io/port"] == str(listeners["status"])
    mounts = {it["mountPath"] for it in gateway.container["volumeMounts"] if it["readOnly"]}
    files = re.findall(r"(/etc/[\w/.]+)", " ".join(gateway.container["args"]))
    for name in ("envoy.yaml", "certificate.yaml"):
        files += re.findall(r"(?:path|filename): (/etc/[\w/.]+)", (DEPLOY / "envoy" / "gateway" / name).read_text())
    assert {it if it in mounts else str(Path(it).parent) for it in files} == mounts


def test_envoy_outlasts_calls_and_leaves_draining_servers_in_time() -> None:
    def seconds(duration: str) -> float:
        return float(duration.removesuffix("s"))

    (server,) = servers("envoy")
    delay_s = float(values_of(server)["MAPLESS_DRAIN_DELAY_S"])
    for cluster in CONFIG["clusters"][:2]:
        (check,) = cluster["health_checks"]
        assert check["grpc_health_check"]["service_name"] in SERVICE_NAMES
        assert check["unhealthy_threshold"] * (seconds(check["interval"]) + seconds(check["timeout"])) < delay_s
    (gateway,) = [it for it in pods(built("envoy")) if it.container["name"] == "envoy"]
    (slept,) = re.findall(r"sleep (\d+)", gateway.container["lifecycle"]["preStop"]["exec"]["command"][-1])
    assert gateway.spec["terminationGracePeriodSeconds"] > int(slept) > default("default_deadline_s")
    text = (DEPLOY / "envoy" / "gateway" / "envoy.yaml").read_text()
    bounds = re.findall(r"(?:grpc_timeout_header_max|stream_idle_timeout): ([\d.]+s)", text)
    assert min(map(seconds, bounds)) > default("max_deadline_s")
