"""The linters of other projects accept the configuration files for their programs."""

import json
import os
import re
import sys
from pathlib import Path

import pytest
import yaml

from app.registry import Store
from app.settings import Settings
from tests.conftest import FindTool, run_program

pytestmark = pytest.mark.system


@pytest.mark.parametrize(
    "command",
    [
        "promtool check rules deploy/monitoring/rules.yml",
        "promtool test rules tests/deploy/alerts.yml",
        "promtool check config --syntax-only deploy/monitoring/prometheus.yml",
        "promtool check config --syntax-only deploy/kubernetes/monitoring/scrape.yaml",
        "haproxy -c -dW -f deploy/haproxy/haproxy.cfg",  # -dW: a warning is an error
        "hadolint --failure-threshold=style Dockerfile",
        "shellcheck .ci/run examples/adapt.sh examples/curl.sh",
        "check-jsonschema --builtin-schema=vendor.compose-spec docker-compose.yml",
        "check-jsonschema --builtin-schema=vendor.github-workflows .github/workflows/ci.yml",
        "check-jsonschema --builtin-schema=vendor.gitlab-ci .gitlab-ci.yml",
    ],
)
def test_linters(find_tool: FindTool, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    monkeypatch.setenv("PROXY_BACKEND", "127.0.0.1:8000")
    program, *arguments = command.split()
    run_program(find_tool(program), *arguments)


def test_the_queries_of_the_dashboard_can_be_parsed(find_tool, repository, tmp_path):
    dashboard = (repository / "deploy/monitoring/grafana/dashboards/scene.json").read_text("utf-8")
    panels = json.loads(dashboard.replace("$__rate_interval", "1m"))["panels"]
    queries = [target["expr"] for panel in panels for target in panel.get("targets", ())]
    rules = [{"record": f"query{n}", "expr": query} for n, query in enumerate(queries)]
    (tmp_path / "rules.yml").write_text(yaml.dump({"groups": [{"name": "all", "rules": rules}]}))
    run_program(find_tool("promtool"), "check", "rules", tmp_path / "rules.yml")


def test_workflows_run_every_python_of_the_packages(repository: Path) -> None:
    classifier = r'"Programming Language :: Python :: (3\.\d+)"'
    expected = re.findall(classifier, (repository / "pyproject.toml").read_text("utf-8"))
    github = yaml.safe_load((repository / ".github/workflows/ci.yml").read_text("utf-8"))
    gitlab = yaml.safe_load((repository / ".gitlab-ci.yml").read_text("utf-8"))
    (job,) = github["jobs"].values()
    assert job["strategy"]["matrix"]["python"] == expected
    assert gitlab["test"]["parallel"]["matrix"] == [{"PYTHON": expected}]
    assert job["steps"][-1]["run"] == gitlab["test"]["script"][0] == ".ci/run"
    for step in job["steps"][:-1]:
        assert re.fullmatch(r"[\w/-]+@[0-9a-f]{40}", step["uses"]), "actions are pinned by commit"


def images(text: str) -> set[str]:
    """Return the images of a Dockerfile, a compose file or a manifest, without stages of builds."""
    stages = set(re.findall(r"^FROM .+ AS (\S+)$", text, re.MULTILINE))
    found = re.findall(r"(?:^FROM|^[ -]+image:(?: &\w+)?) ([^\s*]\S*)", text, re.MULTILINE)
    return {*found} - stages


def test_images_of_others_have_a_digest(repository: Path) -> None:
    """A tag may name another image tomorrow. Images of this repository are built by its users."""
    files = [repository / "Dockerfile", repository / "docker-compose.yml"]
    files += sorted((repository / "deploy").rglob("*.yaml"))
    found = set().union(*(images(path.read_text("utf-8")) for path in files))
    others = {name for name in found if "scene-boltzmann" not in name}
    repositories = {name.partition(":")[0] for name in others}
    expected = {"python", "haproxy", "prom/prometheus", "grafana/grafana", "rclone/rclone"}
    assert repositories == expected
    for name in others:
        assert re.fullmatch(r"[a-z/]+:[\w.-]+@sha256:[0-9a-f]{64}", name), name
    pages = [repository / "README.md", *(repository / "docs").rglob("*.md")]
    for page in pages:
        for name in re.findall(rf"\b(?:{'|'.join(expected)}):\S+", page.read_text("utf-8")):
            assert "@sha256:" in name, f"{page.name}: {name}"


@pytest.fixture
def units(repository: Path, tmp_path: Path) -> Path:
    """A folder with the units of systemd, with this interpreter in place of the installed one."""
    for path in (repository / "deploy/systemd").iterdir():
        text = path.read_text("utf-8").replace("/opt/scene/.venv/bin/python", sys.executable)
        (tmp_path / path.name).write_text(text)
    return tmp_path


@pytest.fixture
def unit(units: Path) -> Path:
    return units / "scene.service"


@pytest.mark.parametrize("name", ["scene.service", "scene-proxy.service"])
def test_the_units_are_valid_and_confined(find_tool: FindTool, units: Path, name: str) -> None:
    systemd = find_tool("systemd-analyze")
    find_tool("haproxy")  # the unit names its path
    verified = run_program(systemd, "verify", "--man=no", units / name)
    assert verified.stdout + verified.stderr == ""
    # The threshold is in tenths: at most 2.0 of 10.
    run_program(systemd, "security", "--offline=true", "--threshold=20", "--no-pager", units / name)


def test_a_proxy_stands_before_the_unit(repository: Path, find_tool: FindTool, units: Path) -> None:
    """The unit names its proxy first, and the proxy asks the port of the service."""
    assert "proxy of scene-proxy.service" in (units / "scene.service").read_text().splitlines()[0]
    proxy = (units / "scene-proxy.service").read_text().replace("/opt/scene", str(repository))
    (settings,) = re.findall(r"^Environment=(.+)$", proxy, re.MULTILINE)
    variables = dict(setting.split("=") for setting in settings.split())
    page = (repository / "docs/operations.md").read_text("utf-8")
    host, _, port = variables["PROXY_BACKEND"].partition(":")
    assert f"SCENE_PORT={port} SCENE_TRUSTED_PROXIES={host} | sudo tee -a /etc/scene/" in page
    assert host == Settings.model_fields["host"].default
    check, _ = re.findall(r"^ExecReload=(.+)$", proxy, re.MULTILINE)
    (start,) = re.findall(r"^ExecStart=(.+)$", proxy, re.MULTILINE)
    assert start.split()[-1] == check.split()[-1]
    run_program(find_tool("haproxy"), *check.split()[1:], env=os.environ | variables)


def test_the_unit_names_settings_and_commands_that_exist(unit: Path, tmp_path: Path) -> None:
    text = unit.read_text("utf-8")
    known = {f"SCENE_{name.upper()}" for name in Settings.model_fields}
    assert set(re.findall(r"\bSCENE_[A-Z_]+\b", text)) - {"SCENE_NAME"} <= known
    (before,) = re.findall(r"^ExecStartPre=-(.+)$", text, re.MULTILINE)
    (tmp_path / "models").mkdir()
    environment = os.environ | {"SCENE_STORE": str(tmp_path / "models")}
    run_program(*before.split(), env=environment)
    assert Store(tmp_path / "models").resolve("default")
