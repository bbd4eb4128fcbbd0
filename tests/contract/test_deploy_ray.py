"""The manifests for Ray are valid for KubeRay and Serve, name what exists, and admit only the gateway.

KubeRay's own schema is too large to be kept here. When these manifests were written they were checked against all of it
(KubeRay 1.7, ray-operator/config/crd/bases/ray.io_rayservices.yaml); what remains is the list of the fields they use.
"""

import importlib
import re
from pathlib import Path

import kubernetes_validate  # type: ignore[import-untyped]
import pytest
import ray
import yaml  # type: ignore[import-untyped]
from ray.serve._private import constants
from ray.serve.config import AutoscalingConfig
from ray.serve.schema import ServeDeploySchema
from support.manifests import CONFINED, VERSIONS, Json, built, check_confined, check_valid, needs_kubectl

from mapless.connection import SCENE_KEY
from mapless_ray.app import build
from mapless_ray.environment import variables
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.settings import PREFIX, Settings, load_settings

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "deploy" / "ray" / "kubernetes"
CALLS = Settings.model_fields["port"].default
RAY, HEAD = {"mapless-ray": "true"}, {"mapless-ray-node": "head"}


def read(name: str) -> list[Json]:
    return list(yaml.safe_load_all((FOLDER / name).read_text()))


(SERVICE,) = read("rayservice.yaml")
CLUSTER: Json = SERVICE["spec"]["rayClusterConfig"]
SERVE: Json = yaml.safe_load(SERVICE["spec"]["serveConfigV2"])
(WORKERS,) = CLUSTER["workerGroupSpecs"]
PODS = {"head": CLUSTER["headGroupSpec"]["template"], "worker": WORKERS["template"]}
POLICIES = {it["metadata"]["name"]: it["spec"] for it in read("network.yaml")}


def container(node: str) -> Json:
    (only,) = PODS[node]["spec"]["containers"]
    return dict(only)


def environment(node: str, prefix: str) -> dict[str, str]:
    """The variables that have a value in the manifest."""
    return {it["name"]: it["value"] for it in container(node)["env"] if it["name"].startswith(prefix) and "value" in it}


# The configuration of Serve


def test_serve_takes_the_configuration() -> None:
    schema = ServeDeploySchema(**SERVE)
    # Nothing is misspelt: Serve ignores unknown fields.
    assert set(schema.model_dump(exclude_unset=True)) == set(SERVE)
    (application,) = schema.applications
    (deployment,) = application.deployments
    (given,) = SERVE["applications"][0]["deployments"]
    assert set(deployment.model_dump(exclude_unset=True)) == set(given)
    scaling = AutoscalingConfig(**given["autoscaling_config"])
    assert set(given["autoscaling_config"]) <= set(type(scaling).model_fields)
    assert (scaling.min_replicas, scaling.max_replicas) == (WORKERS["minReplicas"], WORKERS["maxReplicas"])
    assert schema.grpc_options.port == CALLS
    assert schema.grpc_options.enable_reflection is False


def test_what_serve_imports_is_there() -> None:
    (application,) = SERVE["applications"]
    (deployment,) = application["deployments"]
    policy = deployment["autoscaling_config"]["policy"]["policy_function"]
    for path in (application["import_path"], policy, *SERVE["grpc_options"]["grpc_servicer_functions"]):
        module, _, name = path.partition(":")
        assert callable(getattr(importlib.import_module(module), name))
    built_by_code = build({})
    assert built_by_code._bound_deployment.name == deployment["name"]
    # The config's options replace the code's as a whole; what they would set is in the environment instead.
    lost = (built_by_code._bound_deployment.ray_actor_options or {}).get("runtime_env", {}).get("env_vars", {})
    assert lost.items() <= environment("worker", "RAY_").items()


def test_settings_are_mapless_own(monkeypatch: pytest.MonkeyPatch) -> None:
    (application,) = SERVE["applications"]
    values = environment("worker", PREFIX)
    named = {it["name"] for it in container("worker")["env"] if it["name"].startswith(PREFIX)}
    assert {name.removeprefix(PREFIX).lower() for name in named} <= set(Settings.model_fields)
    for name, value in values.items():
        monkeypatch.setenv(name, value)
    settings = load_settings(application["args"]).settings
    assert settings.tokens_file is not None
    (actor,) = [it["ray_actor_options"] for it in application["deployments"]]
    assert settings.workers == actor["num_cpus"] < int(container("worker")["resources"]["limits"]["cpu"])
    # One replica has the whole device, and a pod has one.
    assert str(actor["num_gpus"]) == container("worker")["resources"]["limits"]["nvidia.com/gpu"] == "1"
    limit_bytes = environment("worker", "RAY_SERVE_GRPC_MAX")["RAY_SERVE_GRPC_MAX_MESSAGE_SIZE"]
    assert int(limit_bytes) == settings.max_message_mib * 2**20


def test_every_pod_has_the_same_ray_settings_that_ray_knows() -> None:
    given = environment("head", "RAY_")
    assert given == environment("worker", "RAY_")
    assert given["RAY_SERVE_ENABLE_HA_PROXY"] == "1"
    source = Path(constants.__file__).read_text()
    for name in given:
        assert f'"{name}"' in source, name
    assert variables().items() <= given.items()
    assert f"hdr({SCENE_KEY})" in given["RAY_SERVE_HAPROXY_BALANCE_ALGORITHM"]


# The configuration of KubeRay


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("node", PODS)
def test_pods_are_valid(node: str, version: str) -> None:
    pod = {"apiVersion": "v1", "kind": "Pod", **PODS[node]}
    pod["metadata"] = {"name": node, **pod["metadata"]}
    kubernetes_validate.validate(pod, version, strict=True)


@pytest.mark.parametrize("node", PODS)
def test_pods_have_no_rights_and_write_to_volumes_alone(node: str) -> None:
    check_confined(PODS[node]["spec"])
    security = PODS[node]["spec"]["securityContext"]
    assert security["runAsGroup"] == security["fsGroup"] == 10001
    assert CLUSTER["autoscalerOptions"]["securityContext"] == CONFINED
    writable = {it["mountPath"] for it in container(node)["volumeMounts"] if not it.get("readOnly")}
    assert writable == {"/cache", "/tmp", "/dev/shm"}
    assert {it["name"] for it in container(node)["volumeMounts"]} == {
        it["name"] for it in PODS[node]["spec"]["volumes"]
    }
    version = re.findall(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)[0]
    assert container(node)["image"] == f"mapless:{version}-ray"
    assert container(node)["image"] in (ROOT / "docker" / "Dockerfile").read_text()


def test_ray_is_the_version_that_is_tried() -> None:
    pinned = re.findall(r'"ray\[serve\]==([\d.]+)"', (ROOT / "pyproject.toml").read_text())
    assert pinned == [CLUSTER["rayVersion"]] == [ray.__version__]


def test_rays_own_ports_ask_for_a_token() -> None:
    assert CLUSTER["authOptions"] == {"mode": "token", "secretName": "mapless-ray-token"}
    for node in PODS:
        assert "RAY_AUTH_MODE" not in {it["name"] for it in container(node)["env"]}  # which would stand above it


def test_a_worker_is_ready_when_a_replica_answers() -> None:
    probe = container("worker")["readinessProbe"]["grpc"]
    assert (probe["port"], probe["service"] in SERVICE_NAMES) == (CALLS, True)
    drain_s = (
        constants.RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S
        + importlib.import_module("mapless_ray.app").DRAIN_GRACE_S
    )
    assert PODS["worker"]["spec"]["terminationGracePeriodSeconds"] > drain_s


# Who gets in


def test_no_service_of_ours_has_more_than_the_port_for_calls() -> None:
    (headless,) = [SERVICE["spec"]["serveService"]]
    assert [port["port"] for port in headless["spec"]["ports"]] == [CALLS]
    assert headless["spec"]["clusterIP"] == "None"
    gateway = ROOT / "deploy" / "envoy" / "gateway"
    for folder in (FOLDER, gateway):
        for path in folder.glob("*.yaml"):
            for document in yaml.safe_load_all(path.read_text()):
                if isinstance(document, dict) and document.get("kind") in {"Service", "Ingress"}:
                    assert [port["port"] for port in document["spec"]["ports"]] == [CALLS]
    assert "serviceType" not in CLUSTER["headGroupSpec"]  # KubeRay's own, for itself, is within the cluster
    envoy = yaml.safe_load((gateway / "envoy.yaml").read_text())
    for cluster in envoy["static_resources"]["clusters"][:2]:
        (group,) = cluster["load_assignment"]["endpoints"]
        (endpoint,) = group["lb_endpoints"]
        at = endpoint["endpoint"]["address"]["socket_address"]
        assert at == {"address": headless["metadata"]["name"], "port_value": CALLS}


def test_policies_admit_the_gateway_ray_and_prometheus() -> None:
    everybody, head = POLICIES["mapless-ray"], POLICIES["mapless-ray-head"]
    assert everybody["podSelector"]["matchLabels"] == RAY
    assert head["podSelector"]["matchLabels"] == RAY | HEAD
    for policy in (everybody, head):
        assert policy["policyTypes"] == ["Ingress", "Egress"]
        assert all(rule.get("from") for rule in policy["ingress"])
    for node, template in PODS.items():
        assert (RAY | {"mapless-ray-node": node}).items() <= template["metadata"]["labels"].items()
    calls, itself, metrics = everybody["ingress"]
    assert calls["from"] == [{"podSelector": {"matchLabels": {"app.kubernetes.io/name": "mapless-gateway"}}}]
    assert calls["ports"] == [{"port": CALLS}]
    assert itself == {"from": [{"podSelector": {"matchLabels": RAY}}]}
    assert {it["port"] for it in metrics["ports"]} == {
        Settings.model_fields["metrics_port"].default,
        8080,  # Ray's, by KubeRay
        constants.RAY_SERVE_HAPROXY_METRICS_PORT,
    }
    (operator,) = head["ingress"]
    assert operator["ports"] == [{"port": 8265}]
    ((source,),) = (operator["from"],)
    assert set(source) == {"namespaceSelector", "podSelector"}  # both at once, not one or the other


@needs_kubectl
def test_what_is_built_is_valid_and_the_gateway_calls_ray() -> None:
    documents = built(FOLDER)
    check_valid(documents)
    (policy,) = [
        it for it in documents if it["kind"] == "NetworkPolicy" and it["metadata"]["name"] == "mapless-gateway"
    ]
    assert policy["spec"]["egress"][0] == {"to": [{"podSelector": {"matchLabels": RAY}}], "ports": [{"port": CALLS}]}
