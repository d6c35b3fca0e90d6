"""Tests of alert rules and dashboard: valid syntax, conditions of alerts, and use of existing metrics only."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from fastapi.routing import APIRoute

from api.http import jobs
from tests.api.service import Service

pytestmark = pytest.mark.slow
MONITORING = Path(__file__).resolve().parents[2] / "deploy" / "monitoring"
OPERATIONS = MONITORING.parents[1] / "docs" / "operations.md"
#: Pattern of metric names in a query, which does not match function names.
_METRIC = re.compile(r"\bsgsst_\w+")


def rules() -> dict[str, str]:
    """Return the expressions of all alerts by name."""
    (group,) = yaml.safe_load((MONITORING / "alerts.yaml").read_text())["groups"]
    return {rule["alert"]: rule["expr"] for rule in group["rules"]}


def queries() -> list[str]:
    """Return all PromQL expressions of alerts and dashboard."""
    board = json.loads((MONITORING / "dashboard.json").read_text())
    return [*rules().values(), *(target["expr"] for panel in board["panels"] for target in panel["targets"])]


def promtool(*words: str | Path) -> None:
    if shutil.which("promtool") is None:
        pytest.skip("promtool is missing: apt-get install -y prometheus")
    ended = subprocess.run(["promtool", *map(str, words)], capture_output=True, text=True)
    assert ended.returncode == 0, f"{ended.stdout}\n{ended.stderr}"


def test_alerts_fire_only_when_they_should() -> None:
    promtool("check", "rules", MONITORING / "alerts.yaml")
    promtool("test", "rules", MONITORING / "alerts_test.yaml")
    promtool("check", "config", "--syntax-only", MONITORING / "prometheus.yaml")


def test_every_alert_is_tested_and_documented() -> None:
    tested = (MONITORING / "alerts_test.yaml").read_text()
    text = OPERATIONS.read_text()
    for name in rules():
        assert re.search(rf"alertname: {name}\n\s+exp_alerts:\n\s+- exp_labels", tested), (
            f"{name} is never seen to fire"
        )
        assert f"`{name}`" in text


def test_every_query_is_valid(tmp_path: Path) -> None:
    records = [{"record": f"query:{number}", "expr": query} for number, query in enumerate(queries())]
    file = tmp_path / "queries.yaml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "queries", "rules": records}]}))
    promtool("check", "rules", file)


def test_every_queried_metric_is_exported(tmp_path: Path) -> None:
    with Service(tmp_path / "data", alone=True) as service, service.client() as client:
        client.get("/v1/jobs")
        shown = set(re.findall(r"^(sgsst_\w+)", client.get("/metrics").text, flags=re.M))
    named = {name for query in queries() for name in _METRIC.findall(query)}
    assert len(named) > 15
    assert named - shown == set()
    written = set(re.findall(r"`(sgsst_\w+)", OPERATIONS.read_text()))
    assert {name for name in written if not name.endswith("_")} - shown - {n[: -len("_count")] for n in shown} == set()


def test_every_queried_route_exists() -> None:
    named = set(re.findall(r'route="([^"]+)"', " ".join(queries())))
    assert named
    assert named <= {route.path for route in jobs.router.routes if isinstance(route, APIRoute)}
