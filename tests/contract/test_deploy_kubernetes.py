"""The manifests are valid for Kubernetes and match one another and the code: ports, services, times, settings.

Each file by itself, and what kustomize makes of them, where kubectl is there to make it; no cluster is asked.
"""

import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import kubernetes_validate  # type: ignore[import-untyped]
import pytest
import yaml  # type: ignore[import-untyped]
from support.manifests import OLDEST, Json, built, check_confined, check_valid, needs_kubectl

from mapless_server.choices import AUTO, BEST_VARIANTS
from mapless_server.networks.weights.catalogue import CATALOGUE
from mapless_server.security import assess_binding
from mapless_server.serve.run import CLOSING_LIMIT_S, NOTIFY_S
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.settings import PREFIX, Settings, load_settings

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
KUBERNETES = ROOT / "deploy" / "kubernetes"
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
BUILDS = ["base", "overlays/cpu", "overlays/shared", "overlays/cuda", "weights"]
SERVERS = BUILDS[:4]
ALONE = ["base", "overlays/cpu", "overlays/cuda"]
"""Those with a store of their own."""
WORKLOADS = ("StatefulSet", "Deployment")
IN_IMAGE = {"MAPLESS_HOST": "0.0.0.0", "MAPLESS_METRICS_HOST": "0.0.0.0"}
IN_SECRETS = {
    ("mapless-database", "url"): "postgresql://mapless:secret@database.example:5432/mapless?sslmode=verify-full"
    "&sslrootcert=/etc/mapless/database/ca.crt"
}
"""What an operator puts into the secrets that variables come from."""


def read(path: Path) -> list[Json]:
    return [document for document in yaml.safe_load_all(path.read_text()) if document]


def of_kind(documents: tuple[Json, ...], kind: str) -> list[Json]:
    return [document for document in documents if document["kind"] == kind]


def the(documents: tuple[Json, ...], kind: str) -> Json:
    (found,) = of_kind(documents, kind)
    return found


def pods(documents: tuple[Json, ...]) -> Iterator[Json]:
    for document in documents:
        if document["kind"] in (*WORKLOADS, "Job"):
            yield document["spec"]["template"]


def workload(documents: tuple[Json, ...]) -> Json:
    """What runs the server."""
    (found,) = [document for document in documents if document["kind"] in WORKLOADS]
    return found


def server(documents: tuple[Json, ...]) -> tuple[Json, Json]:
    """The server's pod and its one container."""
    pod = workload(documents)["spec"]["template"]
    (container,) = pod["spec"]["containers"]
    return pod, container


def settings_of(container: Json, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """What the server makes of the container's environment; an unknown name or a wrong value raises."""
    variables = dict(IN_IMAGE)
    for variable in container["env"]:
        assert variable["name"].startswith(PREFIX)
        variables[variable["name"]] = value_of(variable, container)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    return load_settings({}).settings


def value_of(variable: Json, container: Json) -> str:
    match variable.get("valueFrom"):
        case None:
            return str(variable["value"])
        case {"resourceFieldRef": source}:
            return str(limit(container, source))
        case {"secretKeyRef": source}:
            return IN_SECRETS[source["name"], source["key"]]
        case other:
            raise AssertionError(f"unknown address {other}")


def limit(container: Json, source: Json) -> int:
    assert source == {"containerName": container["name"], "resource": "limits.cpu", "divisor": "1"}
    return int(container["resources"]["limits"]["cpu"])


# The files


def test_kustomizations_name_every_file_and_no_other() -> None:
    for kustomization in KUBERNETES.rglob("kustomization.yaml"):
        (document,) = read(kustomization)
        named = [*document.get("resources", ()), *(patch["path"] for patch in document.get("patches", ()))]
        here = {path.name for path in kustomization.parent.glob("*.yaml")} - {kustomization.name}
        assert {name for name in named if not name.startswith("..")} == here
        for folder in [name for name in named if name.startswith("..")] + document.get("components", []):
            assert (kustomization.parent / folder / "kustomization.yaml").is_file()


# What kustomize makes of them


@needs_kubectl
@pytest.mark.parametrize("folder", BUILDS)
def test_what_is_built_is_valid(folder: str) -> None:
    check_valid(built(KUBERNETES / folder))


@needs_kubectl
@pytest.mark.parametrize("folder", SERVERS)
def test_the_server_takes_its_environment(folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    documents = built(KUBERNETES / folder)
    pod, container = server(documents)
    settings = settings_of(container, monkeypatch)
    # The base asks for tokens and leaves encryption to a mesh; with TLS there is nothing to say.
    assert assess_binding(settings)[0] == (logging.WARNING if folder == "base" else logging.INFO)
    assert settings.workers == int(container["resources"]["limits"]["cpu"])
    assert pod["spec"]["enableServiceLinks"] is False
    wanted = settings.drain_delay_s + settings.drain_grace_s + CLOSING_LIMIT_S + NOTIFY_S
    sleep = container.get("lifecycle", {}).get("preStop", {}).get("sleep", {}).get("seconds", 0)
    assert pod["spec"]["terminationGracePeriodSeconds"] > sleep + wanted


@needs_kubectl
@pytest.mark.parametrize("folder", SERVERS)
def test_ports_are_the_settings(folder: str) -> None:
    documents = built(KUBERNETES / folder)
    pod, container = server(documents)
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    assert ports == {"grpc": default("port"), "metrics": default("metrics_port")}
    for service in of_kind(documents, "Service"):
        assert [(port["port"], port["targetPort"]) for port in service["spec"]["ports"]] == [(ports["grpc"], "grpc")]
    rules = the(documents, "NetworkPolicy")["spec"]["ingress"]
    assert [port["port"] for rule in rules for port in rule["ports"]] == ["grpc", "metrics"]
    assert pod["metadata"]["annotations"]["prometheus.io/port"] == str(ports["metrics"])


@needs_kubectl
@pytest.mark.parametrize("folder", SERVERS)
def test_every_selector_selects_a_pod(folder: str) -> None:
    documents = built(KUBERNETES / folder)
    labels = server(documents)[0]["metadata"]["labels"].items()
    for document in (workload(documents), the(documents, "PodDisruptionBudget")):
        assert document["spec"]["selector"]["matchLabels"].items() <= labels
    assert the(documents, "NetworkPolicy")["spec"]["podSelector"]["matchLabels"].items() <= labels
    for service in of_kind(documents, "Service"):
        assert service["spec"]["selector"].items() <= labels
    headless = workload(documents)["spec"].get("serviceName", "mapless-headless")
    assert [s["metadata"]["name"] for s in of_kind(documents, "Service") if s["spec"].get("clusterIP") == "None"] == [
        headless
    ]
    # The job that fills the weights needs the internet, so the servers' policy must not be for it.
    (job,) = pods(built(KUBERNETES / "weights"))
    assert not the(documents, "NetworkPolicy")["spec"]["podSelector"]["matchLabels"].items() <= (
        job["metadata"]["labels"].items()
    )


@needs_kubectl
def test_probes_ask_for_health_by_grpc_and_never_kill_for_it() -> None:
    _, container = server(built(KUBERNETES / "base"))
    for probe in ("startupProbe", "readinessProbe"):
        assert container[probe]["grpc"]["port"] == default("port")
        assert container[probe]["grpc"]["service"] in SERVICE_NAMES
    for folder in SERVERS:
        _, container = server(built(KUBERNETES / folder))
        assert container["livenessProbe"]["httpGet"] == {"port": "metrics", "path": "/live"}
        assert container["startupProbe"]["periodSeconds"] * container["startupProbe"]["failureThreshold"] >= 300


@needs_kubectl
@pytest.mark.parametrize("folder", SERVERS[1:])
def test_behind_tls_probes_ask_the_port_of_the_metrics(folder: str) -> None:
    _, container = server(built(KUBERNETES / folder))
    startup, readiness = container["startupProbe"], container["readinessProbe"]
    assert not {"grpc", "exec"} & set(startup | readiness)
    assert startup["httpGet"] == readiness["httpGet"] == {"port": "metrics", "path": "/ready"}


@needs_kubectl
@pytest.mark.parametrize("folder", BUILDS)
def test_pods_have_no_rights_and_write_to_volumes_alone(folder: str) -> None:
    documents = built(KUBERNETES / folder)
    for pod in pods(documents):
        spec = pod["spec"]
        check_confined(spec)
        assert spec["securityContext"]["runAsGroup"] == spec["securityContext"]["fsGroup"] == 10001
        assert spec["automountServiceAccountToken"] is False
        (container,) = spec["containers"]
        assert {"cpu", "memory"} <= set(container["resources"]["requests"])
        assert "memory" in container["resources"]["limits"]
        writable = {mount["mountPath"] for mount in container["volumeMounts"] if not mount.get("readOnly")}
        kept = {"weights": {"/weights"}, "overlays/shared": set()}.get(folder, {"/data"})
        assert writable == kept | {"/cache", "/tmp"}


@needs_kubectl
@pytest.mark.parametrize("folder", BUILDS)
def test_what_is_mounted_exists(folder: str) -> None:
    documents = built(KUBERNETES / folder)
    claims = {claim["metadata"]["name"] for claim in of_kind(built(KUBERNETES / "weights"), "PersistentVolumeClaim")}
    templates = {
        claim["metadata"]["name"]
        for stateful_set in of_kind(documents, "StatefulSet")
        for claim in stateful_set["spec"]["volumeClaimTemplates"]
    }
    for pod in pods(documents):
        volumes = {volume["name"]: volume for volume in pod["spec"]["volumes"]}
        (container,) = pod["spec"]["containers"]
        assert {mount["name"] for mount in container["volumeMounts"]} == set(volumes) | templates
        wanted = [v["persistentVolumeClaim"]["claimName"] for v in volumes.values() if "persistentVolumeClaim" in v]
        assert set(wanted) <= claims
        # What the settings name lies in what is mounted.
        secrets = [
            mount["mountPath"] for mount in container["volumeMounts"] if "secret" in volumes.get(mount["name"], {})
        ]
        values = [value_of(variable, container) for variable in container.get("env", ())]
        files = [file for value in values for file in re.findall(r"(?:^|sslrootcert=)(/[^&]+)", value)]
        assert {str(Path(file).parent) for file in files} == set(secrets)


@needs_kubectl
def test_images_are_those_that_the_dockerfile_makes() -> None:
    for folder, target in zip(BUILDS, ("cpu", "cpu", "cpu", "cuda", "cpu"), strict=True):
        for pod in pods(built(KUBERNETES / folder)):
            assert [container["image"] for container in pod["spec"]["containers"]] == [f"mapless:{VERSION}-{target}"]


def test_the_job_fetches_weights_of_permissive_licences() -> None:
    (job,) = read(KUBERNETES / "weights" / "job.yaml")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    command, action, *names = container["args"]
    assert (command, action) == ("weights", "fetch")
    catalogue = {weights.name: weights for weights in CATALOGUE}
    assert names
    assert not any(catalogue[name].licence.restriction for name in names)


@needs_kubectl
@pytest.mark.parametrize("folder", SERVERS[1:])
def test_weights_of_all_that_auto_uses_are_mounted(folder: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU: EdgePoint2 first, then ALIKED with LightGlue; on a GPU the latter."""
    (job,) = read(KUBERNETES / "weights" / "job.yaml")
    (fetching,) = job["spec"]["template"]["spec"]["containers"]
    assert {BEST_VARIANTS["edgepoint2"], "aliked", "aliked-lightglue"} <= set(fetching["args"])
    pod, container = server(built(KUBERNETES / folder))
    assert settings_of(container, monkeypatch).features == AUTO
    (mount,) = [it for it in container["volumeMounts"] if it["mountPath"] == "/weights"]
    (volume,) = [it for it in pod["spec"]["volumes"] if it["name"] == mount["name"]]
    (claim,) = of_kind(built(KUBERNETES / "weights"), "PersistentVolumeClaim")
    assert mount["readOnly"] is volume["persistentVolumeClaim"]["readOnly"] is True
    assert volume["persistentVolumeClaim"]["claimName"] == claim["metadata"]["name"]


# Several servers, and scaling


def extended(folder: str, components: list[str], into: Path) -> Path:
    """A kustomization of an operator's own: what is here, and components."""
    up = Path(*[".."] * (len(into.resolve().parts) - 1))
    kustomization = {
        "apiVersion": "kustomize.config.k8s.io/v1beta1",
        "kind": "Kustomization",
        "resources": [str(up / (KUBERNETES / folder).relative_to("/"))],
        "components": [str(up / (KUBERNETES / "components" / name).relative_to("/")) for name in components],
    }
    (into / "kustomization.yaml").write_text(yaml.safe_dump(kustomization))
    return into


@needs_kubectl
@pytest.mark.parametrize("folder", ALONE)
def test_a_store_of_its_own_has_one_server(folder: str) -> None:
    alone = the(built(KUBERNETES / folder), "StatefulSet")["spec"]
    assert alone["replicas"] == 1
    assert [claim["metadata"]["name"] for claim in alone["volumeClaimTemplates"]] == ["data"]


@needs_kubectl
@pytest.mark.parametrize("folder", ALONE)
def test_any_of_them_can_share_a_database(folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing else changes than where the store is and what follows: volume, replicas, how they are replaced."""
    before, after = built(KUBERNETES / folder), built(extended(folder, ["postgres"], tmp_path))
    for document in after:
        kubernetes_validate.validate(document, OLDEST, strict=True)
    shared = the(after, "Deployment")["spec"]
    assert not {"volumeClaimTemplates", "serviceName"} & set(shared)
    assert shared["replicas"] == 2
    assert shared["strategy"]["rollingUpdate"] == {"maxSurge": 1, "maxUnavailable": 0}
    (_, own), (pod, container) = server(before), server(after)
    startup = container["startupProbe"]
    assert shared["progressDeadlineSeconds"] > startup["periodSeconds"] * startup["failureThreshold"]
    was, settings = settings_of(own, monkeypatch), settings_of(container, monkeypatch)
    assert was.database_url is None
    assert settings.database_url is not None
    assert settings.model_copy(update={"database_url": None}) == was
    for key in (own | container).keys() - {"env", "volumeMounts"}:
        assert container[key] == own[key], key
    mounts = [{mount["mountPath"] for mount in it["volumeMounts"]} for it in (own, container)]
    assert mounts[0] ^ mounts[1] == {"/data", "/etc/mapless/database"}
    assert pod["spec"]["topologySpreadConstraints"][0]["labelSelector"]["matchLabels"].items() <= (
        pod["metadata"]["labels"].items()
    )


@needs_kubectl
def test_the_database_is_let_through_when_there_is_one() -> None:
    def ports(folder: str) -> list[int]:
        rules = the(built(KUBERNETES / folder), "NetworkPolicy")["spec"]["egress"]
        return sorted({port["port"] for rule in rules for port in rule["ports"]})

    (url,) = IN_SECRETS.values()
    assert ports("overlays/cpu") == [53]
    assert ports("overlays/shared") == [53, urlsplit(url).port]


@needs_kubectl
@pytest.mark.parametrize("folder", ALONE)
def test_scaling_joins_any_of_them_that_shares_a_database(folder: str, tmp_path: Path) -> None:
    """As many as there is work for; no other field sets the number."""
    documents = built(extended(folder, ["postgres", "autoscaling"], tmp_path))
    check_valid(documents)
    scaled = the(documents, "Deployment")
    scaler = the(documents, "HorizontalPodAutoscaler")["spec"]
    assert "replicas" not in scaled["spec"]
    assert scaler["scaleTargetRef"] == {
        "apiVersion": scaled["apiVersion"],
        "kind": scaled["kind"],
        "name": scaled["metadata"]["name"],
    }
    # With fewer than two, what may be disrupted is all there is.
    assert scaler["minReplicas"] > the(documents, "PodDisruptionBudget")["spec"]["maxUnavailable"]


@needs_kubectl
def test_servers_with_stores_of_their_own_cannot_be_scaled(tmp_path: Path) -> None:
    command = ["kubectl", "kustomize", str(extended("overlays/cpu", ["autoscaling"], tmp_path))]
    refused = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert refused.returncode != 0
    assert "/kind failed" in refused.stderr


def test_scaling_is_by_a_metric_that_the_adapter_gives() -> None:
    (scaler,) = read(KUBERNETES / "components/autoscaling/autoscaler.yaml")
    (metric,) = scaler["spec"]["metrics"]
    (rule,) = read(ROOT / "deploy/prometheus/adapter-rules.yaml")[0]["rules"]
    assert metric["pods"]["metric"]["name"] == rule["name"]["as"]
    (base,) = read(KUBERNETES / "base/statefulset.yaml")
    (container,) = base["spec"]["template"]["spec"]["containers"]
    # For each worker. A full queue is about half of what is admitted, for what is computed does not wait, and one
    # caller may not fill it; the target must be well below, or nothing would ever be scaled.
    per_worker_s = float(metric["pods"]["target"]["averageValue"]) / int(container["resources"]["limits"]["cpu"])
    assert per_worker_s == 0.5 <= default("max_queued_s") / 4


def default(setting: str) -> Any:
    return Settings.model_fields[setting].default
