"""The configuration of Prometheus and the dashboard use only metrics of the service."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from app.errors import ERRORS
from tests.http.test_monitoring import documented_metrics

pytestmark = pytest.mark.system

# What the language itself has, and what Prometheus adds to every series.
WORDS = {"and", "bool", "by", "ignoring", "offset", "on", "or", "unless", "without"}
GROUPINGS = r"\b(?:by|without|on|ignoring|group_left|group_right)\s*\(([^)]*)\)"
ADDED = {"instance", "job"}


def described() -> dict[str, set[str]]:
    """Every name that a query can use → the labels of its series."""
    found: dict[str, set[str]] = {}
    for name, (kind, labels, _) in documented_metrics().items():
        if kind == "histogram":
            found[f"{name}_bucket"] = labels | {"le"}
            found[f"{name}_sum"] = found[f"{name}_count"] = labels
        else:
            found[name] = labels
    return found


@pytest.fixture(scope="module")
def folder(repository: Path) -> Path:
    return repository / "deploy" / "monitoring"


@pytest.fixture(scope="module")
def dashboard(folder: Path) -> dict[str, Any]:
    text = (folder / "grafana" / "dashboards" / "scene.json").read_text("utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


@pytest.fixture(scope="module")
def rules(folder: Path) -> list[dict[str, Any]]:
    groups = yaml.safe_load((folder / "rules.yml").read_text("utf-8"))["groups"]
    return [rule for group in groups for rule in group["rules"]]


def selectors(query: str) -> Iterator[tuple[str, str]]:
    """Every metric of a query, with the text in its braces."""
    bare = re.sub(GROUPINGS, " ", query)
    for match in re.finditer(
        r"([a-zA-Z_:][\w:]*)\s*(\{[^}]*\})?(\s*\()?", re.sub(r"\[[^\]]*\]", " ", bare)
    ):
        name, braces, call = match.groups()
        if call is None and name not in WORDS:
            yield name, braces or ""


def check(query: str) -> set[str]:
    """The metrics a query names.

    Raises:
        AssertionError: one of them, or a label, or an outcome, is none of the service's.
    """
    known = described() | {"up": set()}
    names = dict.fromkeys(name for name, _ in selectors(query))
    labels = set(ADDED)
    for name, braces in selectors(query):
        assert name in known, name
        labels |= known[name]
        for label, value in re.findall(r'(\w+)\s*[=!]~?\s*"([^"]*)"', braces):
            assert label in known[name] | ADDED, (name, label)
            if label == "outcome" and name != "scene_reloads_total":
                for outcome in value.split("|"):
                    assert outcome in {"success", *ERRORS}, outcome
            elif label == "outcome":
                assert value in {"success", "refused", "failed"}
    assert names
    for grouping in re.findall(GROUPINGS, query):
        for label in grouping.split(","):
            assert label.strip() in labels, label
    return set(names)


def test_the_dashboard_uses_every_metric_and_no_other(dashboard: dict[str, Any]) -> None:
    asked: set[str] = set()
    for panel in dashboard["panels"]:
        assert (panel["type"] == "row") == ("targets" not in panel)
        for target in panel.get("targets", ()):
            asked |= check(target["expr"])
            shown = set(re.findall(r"{{(\w+)}}", target["legendFormat"]))
            assert shown <= set(re.findall(r"\w+", " ".join(re.findall(GROUPINGS, target["expr"]))))
    families, shown = (
        {re.sub(r"_(bucket|sum|count)$", "", name) for name in names}
        for names in (described(), asked)
    )
    assert shown == families
    (variable,) = dashboard["templating"]["list"]
    (name,) = re.findall(r"label_values\((\w+), instance\)", variable["query"]["query"])
    assert name in described()


def test_panels_have_ids_and_places_of_their_own(dashboard: dict[str, Any]) -> None:
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len(set(ids)) == len(ids)
    cells = [
        (panel["gridPos"]["x"] + dx, panel["gridPos"]["y"] + dy)
        for panel in dashboard["panels"]
        for dx in range(panel["gridPos"]["w"])
        for dy in range(panel["gridPos"]["h"])
    ]
    assert len(set(cells)) == len(cells)
    assert max(x for x, _ in cells) < 24


def test_the_rules_use_existing_metrics(rules: list[dict[str, Any]]) -> None:
    assert len({rule["alert"] for rule in rules}) == len(rules) > 5
    for rule in rules:
        check(rule["expr"])
        assert rule["labels"]["severity"] in {"page", "ticket"}
        shown = set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"]))
        (grouped,) = re.findall(GROUPINGS, rule["expr"])[:1] or [""]
        assert shown <= {label.strip() for label in grouped.split(",")}


def test_the_pieces_of_the_profile_find_each_other(
    folder: Path, compose: dict[str, Any], dashboard: dict[str, Any]
) -> None:
    services = compose["services"]
    profile = {name for name in services if services[name].get("profiles") == ["monitoring"]}
    assert profile == {"prometheus", "grafana"}
    config = yaml.safe_load((folder / "prometheus.yml").read_text("utf-8"))
    (scraped,) = config["scrape_configs"]
    assert scraped["static_configs"] == [
        {"targets": [f"scene:{services['scene']['environment']['SCENE_PORT']}"]}
    ]

    def provisioned(path: str) -> Any:
        return yaml.safe_load((folder / "grafana" / "provisioning" / path).read_text())

    (source,) = provisioned("datasources/prometheus.yml")["datasources"]
    assert source["url"] == "http://prometheus:9090"
    used = {panel["datasource"]["uid"] for panel in dashboard["panels"] if "datasource" in panel}
    assert used == {source["uid"]}
    (provider,) = provisioned("dashboards/scene.yml")["providers"]
    mounted = dict(
        volume.removesuffix(":ro").split(":", 1)
        for name in ("prometheus", "grafana")
        for volume in services[name]["volumes"]
        if volume.startswith("./")
    )
    assert provider["options"]["path"] in mounted.values()
    assert set(config["rule_files"]) <= set(mounted.values())
    for source_path in mounted:
        assert (folder.parents[1] / source_path).exists()


def test_images_are_pinned_and_grafana_has_no_login(compose: dict[str, Any]) -> None:
    for name in ("prometheus", "grafana"):
        service = compose["services"][name]
        assert re.fullmatch(r"[a-z/]+:v?\d+\.\d+\.\d+", service["image"])
        for volume in service["volumes"]:
            assert volume.endswith(":ro") or not volume.startswith("."), volume
    environment = compose["services"]["grafana"]["environment"]
    # The administrator of Grafana has a well-known password.
    assert environment["GF_AUTH_BASIC_ENABLED"] == "false"
    assert environment["GF_AUTH_DISABLE_LOGIN_FORM"] == "true"
    assert environment["GF_AUTH_ANONYMOUS_ORG_ROLE"] == "Viewer"
