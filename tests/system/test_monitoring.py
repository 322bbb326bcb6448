"""Prometheus, its rules and the dashboard use metrics that the service has, and find each other.

promtool checks the form of the rules and of the queries: tests/deploy/test_linters.py.
"""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from app.errors import ERRORS
from tests.conftest import REPOSITORY
from tests.http.test_monitoring import documented_metrics

pytestmark = pytest.mark.system

FOLDER = REPOSITORY / "deploy" / "monitoring"
DASHBOARD = FOLDER / "grafana" / "dashboards" / "scene.json"
OUTCOMES = {*ERRORS, "success", "refused", "failed"}


def metrics_of(text: str) -> set[str]:
    """The metrics that queries name. A histogram has three series."""
    names = set(re.findall(r"\bscene_\w+", text))
    return {re.sub(r"_(bucket|sum|count)$", "", name) for name in names}


@pytest.mark.parametrize("path", [FOLDER / "rules.yml", DASHBOARD], ids=lambda path: path.name)
def test_queries_use_metrics_and_outcomes_of_the_service(path: Path) -> None:
    text = path.read_text("utf-8").replace('\\"', '"')
    assert metrics_of(text) <= documented_metrics().keys()
    for outcomes in re.findall(r'outcome[=!]~?"([^"]+)"', text):
        assert {*outcomes.split("|")} <= OUTCOMES


def test_the_dashboard_shows_every_metric_and_label() -> None:
    text = DASHBOARD.read_text("utf-8")
    assert metrics_of(text) == documented_metrics().keys()
    labels = set().union(*(labels for _, labels, _ in documented_metrics().values()))
    assert labels <= set(re.findall(r"\w+", text))


def test_the_pieces_of_the_profile_find_each_other(compose: dict[str, Any]) -> None:
    services = compose["services"]
    config = yaml.safe_load((FOLDER / "prometheus.yml").read_text("utf-8"))
    (scraped,) = config["scrape_configs"]
    (search,) = scraped["dns_sd_configs"]
    # The name of a service has the addresses of all its containers.
    assert search["names"] == ["scene"]
    assert search["names"][0] in services
    port = services["scene"]["environment"]["SCENE_PORT"]
    assert (search["type"], str(search["port"])) == ("A", port)
    key = scraped["authorization"]["credentials_file"]
    assert f"${{API_KEY_FILE:-/dev/null}}:{key}:ro" in services["prometheus"]["volumes"]

    def provisioned(path: str) -> Any:
        return yaml.safe_load((FOLDER / "grafana" / "provisioning" / path).read_text())

    (source,) = provisioned("datasources/prometheus.yml")["datasources"]
    panels = json.loads(DASHBOARD.read_text("utf-8"))["panels"]
    used = {panel["datasource"]["uid"] for panel in panels if "datasource" in panel}
    assert (source["url"], {source["uid"]}) == ("http://prometheus:9090", used)
    (provider,) = provisioned("dashboards/scene.yml")["providers"]
    volumes = [*services["prometheus"]["volumes"], *services["grafana"]["volumes"]]
    mounted = dict(v.removesuffix(":ro").split(":", 1) for v in volumes if v.startswith("./"))
    assert {provider["options"]["path"], *config["rule_files"]} <= {*mounted.values()}
    assert all((REPOSITORY / path).exists() for path in mounted)


def test_grafana_has_no_login(compose: dict[str, Any]) -> None:
    """The administrator of Grafana has a well-known password."""
    environment = compose["services"]["grafana"]["environment"]
    assert environment["GF_AUTH_BASIC_ENABLED"] == "false"
    assert environment["GF_AUTH_DISABLE_LOGIN_FORM"] == "true"
    assert environment["GF_AUTH_ANONYMOUS_ORG_ROLE"] == "Viewer"
