"""Ray in the manifests for KubeRay: Serve takes it, it names what exists, and its ports ask for a token.

As Kubernetes' resources they are checked in test_deploy_manifests.py. KubeRay's own schema is too large.
"""

import importlib
import re
from pathlib import Path

import pytest
import ray
import yaml  # type: ignore[import-untyped]
from ray.serve._private import constants
from ray.serve.config import AutoscalingConfig
from ray.serve.schema import ServeDeploySchema

from mapless.routing import SCENE_KEY
from mapless_ray.app import DRAIN_GRACE_S, build
from mapless_ray.environment import variables
from mapless_server.settings import load_settings

ROOT = Path(__file__).parents[2]
SERVICE = yaml.safe_load((ROOT / "deploy/ray/kubernetes/rayservice.yaml").read_text())["spec"]
CLUSTER = SERVICE["rayClusterConfig"]
(WORKERS,) = CLUSTER["workerGroupSpecs"]
CONFIGURATIONS = {
    "kubernetes": yaml.safe_load(SERVICE["serveConfigV2"]),
    "serve": yaml.safe_load((ROOT / "deploy/ray/serve.yaml").read_text()),
}
each_configuration = pytest.mark.parametrize("name", CONFIGURATIONS)


def environment(template: dict[str, dict[str, list[dict[str, list[dict[str, str]]]]]]) -> dict[str, str]:
    """The variables that have a value in a pod's manifest."""
    (container,) = template["spec"]["containers"]
    return {it["name"]: it["value"] for it in container["env"] if "value" in it}


HEAD, WORKER = environment(CLUSTER["headGroupSpec"]["template"]), environment(WORKERS["template"])


@each_configuration
def test_serve_takes_the_configuration(name: str) -> None:
    given = CONFIGURATIONS[name]
    schema = ServeDeploySchema(**given)
    # Nothing is misspelt: Serve ignores unknown fields.
    assert set(schema.model_dump(exclude_unset=True)) == set(given)
    (deployment,) = schema.applications[0].deployments
    (as_given,) = given["applications"][0]["deployments"]
    assert set(deployment.model_dump(exclude_unset=True)) == set(as_given)
    assert set(as_given["autoscaling_config"]) <= set(AutoscalingConfig.model_fields)
    AutoscalingConfig(**as_given["autoscaling_config"])
    assert schema.grpc_options.enable_reflection is False


@each_configuration
def test_what_serve_imports_and_sets_is_there(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = CONFIGURATIONS[name]
    (application,) = given["applications"]
    (deployment,) = application["deployments"]
    policy = deployment["autoscaling_config"]["policy"]["policy_function"]
    for path in (application["import_path"], policy, *given["grpc_options"]["grpc_servicer_functions"]):
        module, _, function = path.partition(":")
        assert callable(getattr(importlib.import_module(module), function))
    for variable, value in WORKER.items() if name == "kubernetes" else ():
        monkeypatch.setenv(variable, value)
    settings = load_settings(application["args"]).settings
    assert settings.tokens_file is not None
    assert settings.workers == deployment["ray_actor_options"]["num_cpus"]
    assert settings.port == given["grpc_options"]["port"]
    assert int(WORKER["RAY_SERVE_GRPC_MAX_MESSAGE_SIZE"]) == settings.max_message_mib * 2**20


def test_every_pod_has_the_same_ray_settings_that_ray_knows() -> None:
    of_ray = {name: value for name, value in WORKER.items() if name.startswith("RAY_")}
    assert of_ray == HEAD
    source = Path(constants.__file__).read_text()
    assert [name for name in of_ray if f'"{name}"' not in source] == []
    # The configuration's options replace the code's as a whole; what they would set is in the environment instead.
    lost = (build({})._bound_deployment.ray_actor_options or {}).get("runtime_env", {}).get("env_vars", {})
    assert (variables() | lost).items() <= of_ray.items()
    assert of_ray["RAY_SERVE_ENABLE_HA_PROXY"] == "1"
    assert f"hdr({SCENE_KEY})" in of_ray["RAY_SERVE_HAPROXY_BALANCE_ALGORITHM"]


def test_a_cluster_fits_ray_and_what_serve_asks_for() -> None:
    pinned = re.findall(r'"ray\[serve\]==([\d.]+)"', (ROOT / "pyproject.toml").read_text())
    assert pinned == [CLUSTER["rayVersion"]] == [ray.__version__]
    (deployment,) = CONFIGURATIONS["kubernetes"]["applications"][0]["deployments"]
    scaling, actor = deployment["autoscaling_config"], deployment["ray_actor_options"]
    assert (scaling["min_replicas"], scaling["max_replicas"]) == (WORKERS["minReplicas"], WORKERS["maxReplicas"])
    (container,) = WORKERS["template"]["spec"]["containers"]
    assert container["resources"]["limits"]["nvidia.com/gpu"] == str(actor["num_gpus"])
    drain_s = constants.RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S + DRAIN_GRACE_S
    assert WORKERS["template"]["spec"]["terminationGracePeriodSeconds"] > drain_s
    assert CLUSTER["authOptions"] == {"mode": "token", "secretName": "mapless-ray-token"}
    assert "RAY_AUTH_MODE" not in HEAD  # which would stand above it
    assert CLUSTER["autoscalerOptions"]["securityContext"] == container["securityContext"]
    assert "serviceType" not in CLUSTER["headGroupSpec"]  # KubeRay's own service is within the cluster
