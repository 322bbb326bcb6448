"""The manifests for Kubernetes: valid, and in agreement with the image and the service."""

import math
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pytest
import yaml

from app.main import create_app
from app.registry import AliasTarget, Store, load_model_set
from app.settings import Settings
from tests.conftest import FindTool, run_program
from tests.http.stores import make_store
from tests.services import PATIENCE, wait_until
from tests.system.test_container import split_stages

pytestmark = pytest.mark.system

Manifests = dict[tuple[str, str], dict[str, Any]]

OVERLAYS = ("local", "bucket", "autoscaled", "everything")
SETTINGS = {f"SCENE_{name.upper()}" for name in Settings.model_fields}
# Of kinds without a built-in schema, the tests check the important keys.
CUSTOM_KINDS = {"PodMonitor"}


@pytest.fixture(scope="module")
def folder(repository: Path) -> Path:
    return repository / "deploy" / "kubernetes"


@pytest.fixture(scope="module")
def rendered(folder, find_tool, tmp_path_factory):
    """Each overlay, and `everything`: bucket, autoscaled and monitoring together."""
    kubectl = find_tool("kubectl")
    copy = tmp_path_factory.mktemp("kubernetes") / "copy"
    shutil.copytree(folder, copy)
    shutil.copytree(copy / "overlays" / "autoscaled", copy / "overlays" / "everything")
    edited = copy / "overlays" / "everything" / "kustomization.yaml"
    text = edited.read_text("utf-8").replace("../../base", "../bucket")
    edited.write_text(text + "components: [../../monitoring]\n", "utf-8")

    done = {name: run_program(kubectl, "kustomize", copy / "overlays" / name) for name in OVERLAYS}
    assert not any(one.stderr for one in done.values())  # warnings of outdated fields
    return {name: one.stdout for name, one in done.items()}


@dataclass
class Overlay:
    name: str
    text: str

    @cached_property
    def manifests(self) -> Manifests:
        found = list(yaml.safe_load_all(self.text))
        manifests = {(one["kind"], one["metadata"]["name"]): one for one in found}
        assert len(manifests) == len(found)
        return manifests

    def spec(self, kind: str, name: str = "scene") -> dict[str, Any]:
        return self.manifests[kind, name]["spec"]

    @property
    def pod(self) -> dict[str, Any]:
        return self.spec("Deployment")["template"]["spec"]

    @property
    def container(self) -> dict[str, Any]:
        (container,) = self.pod["containers"]
        return container

    @property
    def config(self) -> dict[str, str]:
        data = [one.get("data", {}) for one in self.manifests.values()]
        (config,) = [one for one in data if "SCENE_STORE" in one]
        return config


@pytest.fixture(params=OVERLAYS)
def overlay(request: pytest.FixtureRequest, rendered: dict[str, str]) -> Overlay:
    return Overlay(request.param, rendered[request.param])


def test_manifests_fit_the_schemas_of_kubernetes(overlay: Overlay) -> None:
    # Imported here, because every worker imports every module of tests, and this takes seconds.
    import kubernetes_validate

    kinds = {kind for kind, _ in overlay.manifests}
    assert {"Deployment", "Service", "PodDisruptionBudget", "NetworkPolicy"} < kinds
    for (kind, _), manifest in overlay.manifests.items():
        if kind not in CUSTOM_KINDS:
            kubernetes_validate.validate(manifest, "1.37", strict=True)


def test_probes_ask_routes_of_the_service(overlay: Overlay) -> None:
    container = overlay.container
    routes = create_app(Settings(_env_file=None)).openapi()["paths"]
    _, port = container["ports"]
    probes = [container[f"{name}Probe"]["httpGet"] for name in ("startup", "liveness", "readiness")]
    assert all(probe["path"] in routes and probe["port"] == port["name"] for probe in probes)
    assert [probe["path"] for probe in probes[1:]] == ["/health/live", "/health/ready"]
    # Compilation on another CPU took 250 s on a busy machine.
    startup = container["startupProbe"]
    assert startup["periodSeconds"] * startup["failureThreshold"] >= 500


def test_ports_are_those_of_the_image(repository: Path, overlay: Overlay) -> None:
    stage = split_stages((repository / "Dockerfile").read_text("utf-8"))["runtime"]
    (exposed,) = re.findall(r"^EXPOSE (\d+) (\d+)$", stage, re.MULTILINE)
    for name, number in zip(("SCENE_PORT", "SCENE_HEALTH_PORT"), exposed, strict=True):
        assert f"{name}={number}" in stage
        assert overlay.config[name] == number
    opened = overlay.container["ports"]
    assert [str(port["containerPort"]) for port in opened] == list(exposed)
    for name in ("scene", "scene-replicas"):
        (port,) = overlay.spec("Service", name)["ports"]
        assert (str(port["port"]), port["targetPort"]) == (exposed[0], opened[0]["name"])
    (rule,) = overlay.spec("NetworkPolicy")["ingress"]
    assert [str(port["port"]) for port in rule["ports"]] == list(exposed)


def test_variables_are_valid_settings(monkeypatch, repository, overlay):
    assert set(re.findall(r"\bSCENE_[A-Z0-9_]+", overlay.text)) <= SETTINGS
    assert overlay.config["SCENE_STORE"] in {"/srv/scene/model_store", "/srv/scene/models"}
    # Kubernetes inserts only variables that stand earlier in `env`, so the hosts are last.
    *earlier, hosts = overlay.container["env"]
    value = hosts["value"]
    for name, inserted in (("NAMESPACE", "robots"), ("FURTHER_HOSTS", "robot.example")):
        assert name in {variable["name"] for variable in earlier}
        value = value.replace(f"$({name})", inserted)
    store = str(repository / "model_store")
    environment = overlay.config | {hosts["name"]: value, "SCENE_STORE": store}
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert Settings().accepted_hosts == {
        *("scene", "scene.robots", "scene.robots.svc", "scene.robots.svc.cluster.local"),
        *("localhost", "robot.example"),
    }


def test_the_grace_period_covers_the_end_of_the_service(overlay: Overlay) -> None:
    def seconds(name: str) -> float:
        value = overlay.config.get(f"SCENE_{name.upper()}")
        return float(value or Settings.model_fields[name].default)

    program, before = overlay.container["lifecycle"]["preStop"]["exec"]["command"]
    assert program == "sleep"
    end = math.ceil(int(before) + seconds("drain_seconds") + seconds("drain_timeout"))
    assert overlay.pod["terminationGracePeriodSeconds"] >= end + 5


def test_selectors_match_the_labels(overlay: Overlay) -> None:
    labels = {"app.kubernetes.io/name": "scene"}
    deployment = overlay.spec("Deployment")
    pod = deployment["template"]
    assert pod["metadata"]["labels"] == labels
    for name in ("scene", "scene-replicas"):
        assert overlay.spec("Service", name)["selector"] == labels
    for selector in (
        deployment["selector"],
        overlay.spec("PodDisruptionBudget")["selector"],
        overlay.spec("NetworkPolicy")["podSelector"],
        *(one["labelSelector"] for one in pod["spec"].get("topologySpreadConstraints", ())),
    ):
        assert selector["matchLabels"] == labels


def test_containers_have_no_privileges_and_a_read_only_root(overlay: Overlay) -> None:
    pod = overlay.pod
    assert pod["automountServiceAccountToken"] is False
    assert ("ServiceAccount", pod["serviceAccountName"]) in overlay.manifests
    confined = {"runAsNonRoot": True, "runAsUser": 10001}
    confined["seccompProfile"] = {"type": "RuntimeDefault"}
    assert confined.items() <= pod["securityContext"].items()
    assert not {"hostNetwork", "hostPID", "hostIPC"} & pod.keys()
    for container in [*pod["containers"], *pod.get("initContainers", ())]:
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert {"cpu", "memory"} <= container["resources"]["requests"].keys()
        assert "memory" in container["resources"]["limits"]


def test_the_network_policy_opens_the_ports_in_use(overlay: Overlay) -> None:
    policy = overlay.spec("NetworkPolicy")
    assert set(policy["policyTypes"]) == {"Ingress", "Egress"}
    (entry,) = policy["ingress"]
    peers = {name for peer in entry["from"] for name in peer}
    assert peers == {"podSelector", "namespaceSelector"}
    access = {"matchLabels": {"scene-access": "true"}}
    assert all(selector == access for peer in entry["from"] for selector in peer.values())
    opened = [port["containerPort"] for port in overlay.container["ports"]]
    assert [port["port"] for port in entry["ports"]] == opened
    out = {(port["port"], port["protocol"]) for rule in policy["egress"] for port in rule["ports"]}
    dns = {(53, "UDP"), (53, "TCP")}
    has_bucket = any(one["name"] == "bucket" for one in overlay.pod.get("initContainers", ()))
    assert out == (dns | {(443, "TCP")} if has_bucket else dns)


def test_the_base_asks_for_a_proxy_and_names_the_label_of_its_policy(folder: Path) -> None:
    first, *lines = (folder / "base" / "kustomization.yaml").read_text("utf-8").splitlines()
    assert "needs a proxy in front" in first
    assert any(re.search(r"kubectl label namespace .+ scene-access=true$", line) for line in lines)


def test_the_sidecar_copies_versions(folder: Path, find_tool: FindTool, tmp_path: Path) -> None:
    """A version arrives whole, without its upload's leftovers, and aliases follow the bucket."""
    rclone, rounds = find_tool("rclone"), tmp_path / "rounds"
    (tmp_path / "bin").mkdir()
    counting = tmp_path / "bin" / "rclone"
    counting.write_text(f'#!/bin/sh\necho >>{rounds}\nexec {rclone} "$@"\n')
    counting.chmod(0o755)
    bucket, copied = Store(make_store(tmp_path / "bucket")), Store(tmp_path / "copied")
    (copied.root / "home" / "1.0.0").mkdir(parents=True)
    (copied.root / "home" / "1.0.0" / "card.md.0.partial").touch()  # of a killed container
    shutil.copytree(bucket.root / "home" / "1.0.0", bucket.root / "home" / "2.0.0")
    (bucket.root / "home" / "2.0.0" / "manifest.json").unlink()
    (bucket.root / "home" / "1.0.0" / "notes.txt").touch()
    variables = {"BUCKET": str(bucket.root), "INTERVAL": "0.1", "RCLONE_CONFIG": "/notfound"}
    command = ["sh", folder / "overlays" / "bucket" / "copy.sh", copied.root]
    path = f"{counting.parent}:{os.environ['PATH']}"
    process = subprocess.Popen(command, env=os.environ | variables | {"PATH": path})
    try:
        wait_until(lambda: "default" in copied.aliases())
        models = load_model_set(copied)
        assert not models.failures
        assert models.versions["home"] == ("1.0.0", "1.1.0")
        assert models.versions.keys() == {"general", "home", "plain"}
        before = copied.state()
        bucket.set_alias("default", AliasTarget(name="home"))
        wait_until(lambda: copied.aliases() == bucket.aliases())
        assert copied.state() != before
        before, calls = copied.state(), rounds.stat().st_size
        wait_until(lambda: rounds.stat().st_size >= calls + 12)  # several rounds
        assert copied.state() == before  # else each replica would load everything again
    finally:
        process.terminate()
        assert process.wait(timeout=PATIENCE) is not None


def test_prometheus_sends_the_key(rendered: dict[str, str]) -> None:
    overlay = Overlay("everything", rendered["everything"])
    container, monitor = overlay.container, overlay.spec("PodMonitor")
    labels = overlay.spec("Deployment")["template"]["metadata"]["labels"]
    assert monitor["selector"]["matchLabels"] == labels
    assert labels[monitor["jobLabel"]] == "scene"  # the job of the alerts
    (endpoint,) = monitor["podMetricsEndpoints"]
    assert endpoint["port"] == container["ports"][0]["name"]
    (key,) = [one for one in container["env"] if one["name"] == "SCENE_API_KEY"]
    secret = key["valueFrom"]["secretKeyRef"]
    assert endpoint["authorization"]["credentials"] == {k: secret[k] for k in ("name", "key")}
