"""The manifests with Envoy are valid for Kubernetes and match the servers, their settings and Envoy's configuration."""

import re
from pathlib import Path

import yaml  # type: ignore[import-untyped]
from support.manifests import Json, built, check_confined, check_valid, needs_kubectl

from mapless.connection import SCENE_KEY
from mapless.v1 import localization_service_pb2
from mapless_server.services.handlers import SERVICE_NAMES
from mapless_server.settings import Settings

FOLDER = Path(__file__).parents[2] / "deploy" / "envoy"
CONFIG = yaml.safe_load((FOLDER / "gateway" / "envoy.yaml").read_text())
CLUSTERS = {it["name"]: it for it in CONFIG["static_resources"]["clusters"]}
LISTENERS = {it["name"]: it for it in CONFIG["static_resources"]["listeners"]}
GATEWAY = {"app.kubernetes.io/name": "mapless-gateway"}
SERVERS = {"app.kubernetes.io/name": "mapless"}


def the(kind: str, name: str) -> Json:
    (found,) = [it for it in built(FOLDER) if it["kind"] == kind and it["metadata"]["name"] == name]
    return found


def gateway() -> tuple[Json, Json]:
    pod = the("Deployment", "mapless-gateway")["spec"]["template"]
    (container,) = pod["spec"]["containers"]
    return pod, container


def port_of(listener: str) -> int:
    port: int = LISTENERS[listener]["address"]["socket_address"]["port_value"]
    return port


def manager(listener: str) -> Json:
    ((chain,),) = (LISTENERS[listener]["filter_chains"],)
    (only,) = chain["filters"]
    config: Json = only["typed_config"]
    return config


def seconds(duration: str) -> float:
    assert re.fullmatch(r"[\d.]+s", duration)
    return float(duration[:-1])


@needs_kubectl
def test_everything_is_valid_and_in_its_namespace() -> None:
    check_valid(built(FOLDER))


@needs_kubectl
def test_the_gateway_is_confined_as_the_servers_are() -> None:
    for name in ("mapless", "mapless-gateway"):
        pod = the("Deployment", name)["spec"]["template"]["spec"]
        assert pod["automountServiceAccountToken"] is False
        check_confined(pod)
    _, container = gateway()
    assert re.fullmatch(r"envoyproxy/envoy:v\d+\.\d+\.\d+", container["image"])
    assert all(mount["readOnly"] for mount in container["volumeMounts"])


@needs_kubectl
def test_ports_are_those_of_the_configuration() -> None:
    pod, container = gateway()
    ports = {port["name"]: port["containerPort"] for port in container["ports"]}
    assert ports == {"grpc": port_of("calls"), "status": port_of("status")}
    assert pod["metadata"]["annotations"]["prometheus.io/port"] == str(ports["status"])
    for probe in ("startupProbe", "readinessProbe"):
        assert container[probe]["httpGet"] == {"port": "status", "path": "/ready"}
    service = the("Service", "mapless-gateway")["spec"]
    assert service["selector"].items() <= pod["metadata"]["labels"].items()
    assert [port["targetPort"] for port in service["ports"]] == ["grpc"]


@needs_kubectl
def test_servers_are_found_by_their_name_and_port() -> None:
    headless = the("Service", "mapless-headless")["spec"]
    assert headless["clusterIP"] == "None"
    server = the("Deployment", "mapless")["spec"]["template"]
    assert headless["selector"].items() <= server["metadata"]["labels"].items()
    for name in ("by_scene", "by_load"):
        (group,) = CLUSTERS[name]["load_assignment"]["endpoints"]
        (endpoint,) = group["lb_endpoints"]
        at = endpoint["endpoint"]["address"]["socket_address"]
        assert at == {"address": "mapless-headless", "port_value": Settings.model_fields["port"].default}
        assert {"port": at["port_value"]}.items() <= headless["ports"][0].items()


@needs_kubectl
def test_only_the_gateway_reaches_the_servers() -> None:
    calls, metrics = the("NetworkPolicy", "mapless")["spec"]["ingress"]
    assert calls["from"] == [{"podSelector": {"matchLabels": GATEWAY}}]
    assert calls["ports"] == [{"port": "grpc"}]
    assert metrics["ports"] == [{"port": "metrics"}]
    policy = the("NetworkPolicy", "mapless-gateway")["spec"]
    assert policy["policyTypes"] == ["Ingress", "Egress"]
    assert [[port["port"] for port in rule["ports"]] for rule in policy["ingress"]] == [["grpc"], ["status"]]
    assert all(rule["from"] for rule in policy["ingress"])
    servers, names = policy["egress"]
    assert servers["to"] == [{"podSelector": {"matchLabels": SERVERS}}]
    assert servers["ports"] == [{"port": Settings.model_fields["port"].default}]
    assert {port["port"] for port in names["ports"]} == {53}


@needs_kubectl
def test_files_of_the_configuration_are_mounted() -> None:
    pod, container = gateway()
    mounts = {mount["mountPath"] for mount in container["volumeMounts"]}
    assert container["args"][:2] == ["--config-path", "/etc/envoy/envoy.yaml"]
    named = re.findall(r"(?:path|filename): (/[\w/.]+)", (FOLDER / "gateway" / "envoy.yaml").read_text())
    named += re.findall(r"filename: (/[\w/.]+)", (FOLDER / "gateway" / "certificate.yaml").read_text())
    files = [Path(it) for it in named if it not in {"/ready", "/metrics"} and not it.startswith("/mapless.v1.")]
    assert {str(it) for it in files} & mounts == {"/etc/mapless/tls"}
    assert {str(it if str(it) in mounts else it.parent) for it in files} == mounts
    (configured,) = [it for it in built(FOLDER) if it["kind"] == "ConfigMap"]
    assert set(configured["data"]) == {"envoy.yaml", "certificate.yaml"}
    (volume,) = [it for it in pod["spec"]["volumes"] if it["name"] == "config"]
    assert volume["configMap"]["name"] == configured["metadata"]["name"]


@needs_kubectl
def test_a_server_that_drains_is_left_before_it_stops() -> None:
    server = the("Deployment", "mapless")["spec"]["template"]["spec"]["containers"][0]
    (delay,) = [it["value"] for it in server["env"] if it["name"] == "MAPLESS_DRAIN_DELAY_S"]
    for name in ("by_scene", "by_load"):
        (check,) = CLUSTERS[name]["health_checks"]
        assert check["grpc_health_check"]["service_name"] in SERVICE_NAMES
        noticed_s = check["unhealthy_threshold"] * (seconds(check["interval"]) + seconds(check["timeout"]))
        assert noticed_s < float(delay)


@needs_kubectl
def test_a_gateway_that_goes_has_time_for_the_calls_that_run() -> None:
    pod, container = gateway()
    (slept,) = re.findall(r"sleep (\d+)", container["lifecycle"]["preStop"]["exec"]["command"][-1])
    assert (
        pod["spec"]["terminationGracePeriodSeconds"] > int(slept) > Settings.model_fields["default_deadline_s"].default
    )


def test_calls_with_a_scene_are_hashed_and_others_balanced() -> None:
    (host,) = manager("calls")["route_config"]["virtual_hosts"]
    _, watching, by_scene, by_load, health = host["routes"]
    method = localization_service_pb2.DESCRIPTOR.services_by_name["LocalizationService"].methods_by_name["WatchQueries"]
    assert watching["match"]["path"] == f"/{method.containing_service.full_name}/{method.name}"
    assert by_scene["match"]["headers"][1:] == [{"name": SCENE_KEY, "present_match": True}]
    for route in (watching, by_scene):
        assert route["route"]["hash_policy"] == [{"header": {"header_name": SCENE_KEY}}]
        assert CLUSTERS[route["route"]["cluster"]]["lb_policy"] == "RING_HASH"
    for route in (by_load, health):
        assert CLUSTERS[route["route"]["cluster"]]["lb_policy"] == "LEAST_REQUEST"
    assert {route["route"]["timeout"] for route in host["routes"]} == {"0s"}
    longest_s = Settings.model_fields["max_deadline_s"].default
    for route in (by_scene, by_load):
        assert seconds(route["route"]["max_stream_duration"]["grpc_timeout_header_max"]) > longest_s
    assert seconds(manager("calls")["stream_idle_timeout"]) > longest_s
