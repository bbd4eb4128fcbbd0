"""Dashboard and alerts query what the server reports: every selector finds a series, every label exists.

The series are those of a `Metrics` to which everything happened once. An alert or a panel that asks for what is not
there stays empty for ever, without any error.
"""

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import promql_parser
import pytest
import yaml  # type: ignore[import-untyped]
from prometheus_client import generate_latest

from mapless_server.cache import LruCache
from mapless_server.method.coarse.token_cache import TokenCacheCounters
from mapless_server.observability.metrics import LOCALIZED, STAGES, Metrics
from mapless_server.observability.scraped import SceneAge
from mapless_server.settings import Settings

DEPLOY = Path(__file__).parents[2] / "deploy"
DASHBOARD = json.loads((DEPLOY / "grafana/dashboards/mapless.json").read_text())
RULES = [
    rule
    for group in yaml.safe_load((DEPLOY / "prometheus/alerts.yaml").read_text())["groups"]
    for rule in group["rules"]
]
ALERTS = [rule for rule in RULES if "alert" in rule]
RECORDED = {rule["record"]: rule["expr"] for rule in RULES if "record" in rule}
PROMETHEUS = yaml.safe_load((DEPLOY / "prometheus/prometheus.yaml").read_text())
SERVICES = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
TARGET_LABELS = {"job": "mapless", "instance": "a:9464", "namespace": "mapless", "pod": "mapless-0"}
"""The labels that Prometheus adds to every series."""

Labels = dict[str, str]


def everything_happened() -> Metrics:
    """Metrics with a series of everything; those with labels of ours exist from the start."""
    metrics = Metrics()
    for stage in STAGES:
        metrics.computed(stage, "392x518x11", 2, 0.1)
    metrics.stages({"decode": 0.01, "aliked/features": 0.1})
    metrics.answered(
        LOCALIZED,
        inlier_count=100,
        match_count=200,
        reprojection_error_px=0.5,
        scale_deviation=0.01,
        accuracy_radius_m=0.01,
    )
    metrics.stored("read", 0.01)
    metrics.built("0.1.0", "geometric", "sift", "")
    metrics.scraped.reference_cache = lambda: LruCache[str](0)
    metrics.scraped.retrieval_index = lambda: 1
    metrics.scraped.token_cache = TokenCacheCounters
    metrics.scraped.gpu_memory = lambda: {"allocated": 1.0, "reserved": 1.0, "peak": 1.0}
    metrics.scraped.certificate_expiry = lambda: 1.0
    metrics.scraped.scenes = [SceneAge("hall", 100, 0.8, 0.9, 0.6, 1, 3, 2)]
    metrics.scraped.connections, metrics.scraped.most_connections = (lambda: 1), (lambda: 768)
    return metrics


def series() -> dict[str, list[Labels]]:
    """The series of a server to which everything happened once: labels by name."""
    found: dict[str, list[Labels]] = {"up": [TARGET_LABELS]} | {name: [{}] for name in RECORDED}
    for family in everything_happened().registry.collect():
        for sample in family.samples:
            found.setdefault(sample.name, []).append({**sample.labels, **TARGET_LABELS})
    return found


SERIES = series()


def found_by(selector: promql_parser.VectorSelector) -> list[Labels]:
    def fits(value: str, matcher: promql_parser.Matcher) -> bool:
        operator = promql_parser.MatchOp
        if matcher.op in (operator.Equal, operator.NotEqual):
            return (value == matcher.value) is (matcher.op == operator.Equal)
        return (re.fullmatch(matcher.value, value) is not None) is (matcher.op == operator.Re)

    known, matchers = SERIES.get(selector.name or "", ()), selector.matchers.matchers
    return [labels for labels in known if all(fits(labels.get(it.name, ""), it) for it in matchers)]


def expressions() -> Iterator[tuple[str, str]]:
    """All of PromQL there is, and where; Grafana's variables stand for anything."""
    for rule in RULES:
        yield rule.get("alert") or rule["record"], rule["expr"]
    queries = [(panel["title"], target["expr"]) for panel in PANELS for target in panel["targets"]]
    queries += [(it["name"], it["expr"]) for it in DASHBOARD["annotations"]["list"]]
    for where, expression in queries:
        plain = expression.replace("$__rate_interval", "1m").replace('=~"$job"', '=~".+"')
        yield f"panel {where}", plain.replace('=~"$instance"', '=~".+"')


EXPRESSIONS = list(expressions())


def nodes(expression: str) -> list[promql_parser.Expr]:
    found: list[promql_parser.Expr] = []
    promql_parser.walk(promql_parser.parse(expression), lambda node: found.append(node))
    return found


def selectors(expression: str) -> list[promql_parser.VectorSelector]:
    return [node for node in nodes(expression) if isinstance(node, promql_parser.VectorSelector)]


@pytest.mark.parametrize(("where", "expression"), EXPRESSIONS, ids=[where for where, _ in EXPRESSIONS])
def test_series_values_and_labels_that_are_asked_for_exist(where: str, expression: str) -> None:
    """Also each alternative: Prometheus ignores a misspelt one, INTERNAL|UNKOWN. UNKNOWN is grpc's own, never ours."""
    assert selectors(expression)
    labels_there = set()
    for selector in selectors(expression):
        found = found_by(selector)
        assert found, f"nothing is {selector}"
        labels_there |= {name for labels in found for name in labels}
        for matcher in selector.matchers.matchers:
            values = {labels.get(matcher.name, "") for labels in SERIES[selector.name or ""]} | {"UNKNOWN"}
            for alternative in matcher.value.split("|"):
                assert any(re.fullmatch(alternative, it) for it in values), f"{matcher.name} is never {alternative}"
    for node in nodes(expression):
        if isinstance(node, promql_parser.AggregateExpr) and node.modifier is not None:
            assert set(node.modifier.labels) <= labels_there
        if isinstance(node, promql_parser.BinaryExpr) and node.modifier is not None and node.modifier.matching:
            assert set(node.modifier.matching.labels) <= labels_there


def test_counters_are_not_read_as_they_are() -> None:
    """Their value depends on when the server was started. What ends the process may be compared with 0."""
    for where, expression in EXPRESSIONS:
        in_windows = {
            node.vector_selector.name for node in nodes(expression) if isinstance(node, promql_parser.MatrixSelector)
        }
        bare = {selector.name for selector in selectors(expression)} - in_windows
        assert not {name for name in bare if (name or "").endswith(("_total", "_bucket", "_count", "_sum"))} - {
            "mapless_fatal_total"
        }, where


# Alerts and Prometheus


def promtool(*arguments: str, given: bytes = b"") -> bytes:
    """The output of Prometheus's own checks; an error if they find a fault."""
    program = shutil.which("promtool")
    if program is None:
        assert os.environ.get("TEST_PROMTOOL") != "required"
        pytest.skip("promtool, of Prometheus, is not here")
    return subprocess.run([program, *arguments], input=given, check=True, capture_output=True, timeout=60).stdout


def test_promtool_takes_configuration_rules_and_metrics() -> None:
    promtool("check", "config", str(DEPLOY / "prometheus/prometheus.yaml"))
    promtool("check", "rules", "--lint-fatal", str(DEPLOY / "prometheus/alerts.yaml"))
    assert promtool("check", "metrics", given=generate_latest(Metrics().registry)) == b""


@pytest.mark.nightly
def test_alerts_come_and_stay_away() -> None:
    promtool("test", "rules", str(DEPLOY / "prometheus/alerts_test.yaml"))


def test_every_alert_is_tried_out_and_in_the_runbook() -> None:
    names = {rule["alert"] for rule in ALERTS}
    assert len(names) == len(ALERTS)
    assert all(rule["labels"]["severity"] in ("page", "ticket") for rule in ALERTS)
    assert all(rule["annotations"]["summary"] for rule in ALERTS)
    runbook = (DEPLOY.parent / "docs/operation/alerts.md").read_text()
    rows = "".join(re.findall(r"^\| `Mapless.*", runbook, re.MULTILINE))
    assert set(re.findall(r"`(Mapless\w+)`", rows)) == names
    tests = yaml.safe_load((DEPLOY / "prometheus/alerts_test.yaml").read_text())["tests"]
    raised = {case["alertname"] for test in tests for case in test["alert_rule_test"] if case["exp_alerts"]}
    # Each is another one with other numbers.
    assert names - raised == {"MaplessErrorsSlow", "MaplessErrorsCreeping", "MaplessCertificateEndsNow"}


def test_recording_rules_measure_in_the_windows_of_their_names() -> None:
    windows = {name: re.findall(r"\[(\w+)\]", expr) for name, expr in RECORDED.items()}
    assert all(set(found) == set(re.findall(r"(?:ratio_rate|increase)(\w+)$", name)) for name, found in windows.items())
    burning = [rule["expr"] for rule in ALERTS if rule["alert"].startswith("MaplessErrors")]
    burning += [
        target["expr"] for panel in PANELS if panel["title"].startswith("Burn rate") for target in panel["targets"]
    ]
    assert {number for expr in burning for number in re.findall(r"0\.\d+", expr)} == {"0.005"}  # one objective


def test_grafana_is_given_what_the_dashboard_wants() -> None:
    variables = {it["name"]: it for it in DASHBOARD["templating"]["list"]}
    used = set(re.findall(r"\$\{?(\w+)", json.dumps([DASHBOARD["panels"], DASHBOARD["annotations"]])))
    assert used - {"__rate_interval"} == set(variables)
    for name in ("job", "instance"):
        (metric,) = re.findall(r"label_values\((\w+)", variables[name]["query"])
        assert metric in SERIES
    provisioning = DEPLOY / "grafana" / "provisioning"
    (source,) = yaml.safe_load((provisioning / "datasources/prometheus.yaml").read_text())["datasources"]
    (provider,) = yaml.safe_load((provisioning / "dashboards/mapless.yaml").read_text())["providers"]
    (variable,) = [it for it in variables.values() if it["type"] == "datasource"]
    assert (variable["query"], variable["current"]["value"]) == (source["type"], source["uid"])
    (port,) = re.findall(r"^http://prometheus:(\d+)$", source["url"])
    assert f"127.0.0.1:{port}:{port}" in SERVICES["prometheus"]["ports"]
    assert f"./grafana/dashboards:{provider['options']['path']}:ro" in SERVICES["grafana"]["volumes"]
    home = Path(SERVICES["grafana"]["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"])
    assert str(home.parent) == provider["options"]["path"]
    assert (DEPLOY / "grafana/dashboards" / home.name).is_file()
    assert source["jsonData"]["timeInterval"] == PROMETHEUS["global"]["scrape_interval"]


def test_prometheus_asks_the_server_where_it_answers() -> None:
    (job,) = PROMETHEUS["scrape_configs"]
    (asked,) = job["dns_sd_configs"]
    assert set(asked["names"]) <= set(SERVICES)
    # Of a name with several containers, all are found.
    assert (asked["type"], asked["port"]) == ("A", Settings.model_fields["metrics_port"].default)
    (config,) = [it.partition("=")[2] for it in SERVICES["prometheus"]["command"] if it.startswith("--config.file=")]
    assert f"./prometheus:{Path(config).parent}:ro" in SERVICES["prometheus"]["volumes"]
    assert (DEPLOY / "prometheus" / Path(config).name).is_file()


def test_the_adapter_asks_for_what_is_scaled_by() -> None:
    (rule,) = yaml.safe_load((DEPLOY / "prometheus/adapter-rules.yaml").read_text())["rules"]
    (found,) = selectors(rule["seriesQuery"])
    assert found_by(found)
    assert set(rule["resources"]["overrides"]) <= set(TARGET_LABELS)
    query = rule["metricsQuery"].replace("<<.GroupBy>>", "pod").replace("<<.Series>>", found.name or "")
    (selector,) = selectors(query.replace("<<.LabelMatchers>>", 'namespace="mapless",pod=~"mapless-0"'))
    assert {labels["stage"] for labels in found_by(selector)} == set(STAGES)
