"""The manifests for Kubernetes: valid, and in agreement with the image and the service."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from app.main import create_app
from app.settings import Settings
from tests.system.test_container import split_stages

pytestmark = pytest.mark.system

FindTool = Callable[[str], Path]
Manifests = dict[tuple[str, str], dict[str, Any]]

OVERLAYS = ("local", "s3", "autoscaled", "everything")
SETTINGS = {f"SCENE_{name.upper()}" for name in Settings.model_fields}
UNITS = {"Mi": 2**20, "Gi": 2**30}
# Of kinds without a built-in schema, the tests check the important keys.
CUSTOM_KINDS = {"PodMonitor"}


@pytest.fixture(scope="module")
def folder(repository: Path) -> Path:
    return repository / "deploy" / "kubernetes"


@pytest.fixture(scope="module")
def rendered(
    folder: Path, require_system_tool: FindTool, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, str]:
    """Each overlay, and `everything`: s3, autoscaled and monitoring together."""
    kubectl = require_system_tool("kubectl")
    copy = tmp_path_factory.mktemp("kubernetes") / "copy"
    shutil.copytree(folder, copy)
    shutil.copytree(copy / "overlays" / "autoscaled", copy / "overlays" / "everything")
    edited = copy / "overlays" / "everything" / "kustomization.yaml"
    text = edited.read_text("utf-8").replace("../../base", "../s3")
    edited.write_text(text + "components: [../../monitoring]\n", "utf-8")

    def render(name: str) -> str:
        command = [kubectl, "kustomize", copy / "overlays" / name]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert not done.stderr  # warnings of outdated fields
        return done.stdout

    return {name: render(name) for name in OVERLAYS}


@pytest.fixture(params=OVERLAYS)
def overlay(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture
def manifests(rendered: dict[str, str], overlay: str) -> Manifests:
    return by_name(rendered[overlay])


@pytest.fixture
def pod(manifests: Manifests) -> dict[str, Any]:
    return manifests["Deployment", "scene"]["spec"]["template"]["spec"]


@pytest.fixture
def container(pod: dict[str, Any]) -> dict[str, Any]:
    (container,) = pod["containers"]
    return container


def by_name(text: str) -> Manifests:
    found = list(yaml.safe_load_all(text))
    manifests = {(one["kind"], one["metadata"]["name"]): one for one in found}
    assert len(manifests) == len(found)
    return manifests


def config(manifests: Manifests) -> dict[str, str]:
    (found,) = [one["data"] for (kind, _), one in manifests.items() if kind == "ConfigMap"]
    return found


def size(quantity: str) -> int:
    return int(quantity[:-2]) * UNITS[quantity[-2:]]


def test_manifests_fit_the_schemas_of_kubernetes(manifests: Manifests) -> None:
    kinds = {kind for kind, _ in manifests}
    assert {"Deployment", "Service", "PodDisruptionBudget", "NetworkPolicy"} < kinds
    for (kind, _), manifest in manifests.items():
        if kind not in CUSTOM_KINDS:
            kubernetes_validate.validate(manifest, "1.37", strict=True)


def test_probes_ask_routes_of_the_service(container: dict[str, Any]) -> None:
    schema = create_app(Settings(_env_file=None)).openapi()
    (port,) = container["ports"]
    paths = {}
    for probe in ("startupProbe", "livenessProbe", "readinessProbe"):
        get = container[probe]["httpGet"]
        assert "get" in schema["paths"][get["path"]]
        assert get["port"] == port["name"]
        paths[probe] = get["path"]
    assert paths["livenessProbe"] == "/health/live"
    assert paths["readinessProbe"] == "/health/ready"
    # Compilation on another CPU took 250 s on a busy machine.
    startup = container["startupProbe"]
    assert startup["periodSeconds"] * startup["failureThreshold"] >= 500


def test_ports_are_those_of_the_image(
    repository: Path, manifests: Manifests, container: dict[str, Any]
) -> None:
    stage = split_stages((repository / "Dockerfile").read_text("utf-8"))["runtime"]
    (exposed,) = [int(i.argument) for i in stage if i.keyword == "EXPOSE"]
    environment = " ".join(i.argument for i in stage if i.keyword == "ENV")
    assert f"SCENE_PORT={exposed}" in environment
    assert config(manifests)["SCENE_PORT"] == str(exposed)
    assert [port["containerPort"] for port in container["ports"]] == [exposed]
    for name in ("scene", "scene-replicas"):
        (port,) = manifests["Service", name]["spec"]["ports"]
        assert (port["port"], port["targetPort"]) == (exposed, container["ports"][0]["name"])


def test_every_variable_is_a_setting(
    repository: Path, rendered: dict[str, str], overlay: str
) -> None:
    assert set(re.findall(r"\bSCENE_[A-Z0-9_]+", rendered[overlay])) <= SETTINGS
    compose = (repository / "docker-compose.yml").read_text("utf-8")
    assert set(re.findall(r"\bSCENE_[A-Z0-9_]+", compose)) <= SETTINGS


def test_compose_passes_all_settings(repository: Path) -> None:
    services = yaml.safe_load((repository / "docker-compose.yml").read_text("utf-8"))["services"]
    assert services["scene"]["env_file"] == [{"path": ".env", "required": False}]
    assert "/.env" in {f"/{line}" for line in (repository / ".gitignore").read_text().splitlines()}


def test_the_values_are_valid_settings(
    monkeypatch: pytest.MonkeyPatch,
    repository: Path,
    manifests: Manifests,
    container: dict[str, Any],
) -> None:
    environment = environment_of(manifests, container)
    if environment["SCENE_STORE"].startswith("/"):
        assert environment["SCENE_STORE"] in {"/srv/scene/model_store", "/srv/scene/models"}
        environment["SCENE_STORE"] = str(repository / "model_store")
    else:
        assert environment["SCENE_TRUSTED_KEYS"] == ""
        environment["SCENE_TRUSTED_KEYS"] = "AAAA"
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    settings = Settings()
    assert settings.accepted_hosts == {
        *("scene", "scene.robots", "scene.robots.svc", "scene.robots.svc.cluster.local"),
        *("[fd00::7]", "127.0.0.1", "localhost"),
    }


def environment_of(manifests: Manifests, container: dict[str, Any]) -> dict[str, str]:
    """The environment that Kubernetes would give to the container, without Secrets."""
    data = config(manifests)
    fields = {"metadata.namespace": "robots", "status.podIP": "fd00::7"}
    # Kubernetes inserts only variables that stand earlier in `env`.
    known: dict[str, str] = {}
    for variable in container["env"]:
        source = variable.get("valueFrom", {})
        if "fieldRef" in source:
            known[variable["name"]] = fields[source["fieldRef"]["fieldPath"]]
        elif "configMapKeyRef" in source:
            known[variable["name"]] = data[source["configMapKeyRef"]["key"]]
        elif "value" in variable:
            value = re.sub(r"\$\((\w+)\)", lambda match: known[match[1]], variable["value"])
            known[variable["name"]] = value
    return data | known


def test_variables_of_the_service_discovery_do_not_change_settings(pod: dict[str, Any]) -> None:
    # For a Service `scene`, Kubernetes would set SCENE_PORT=tcp://10.0.0.1:8000.
    assert pod["enableServiceLinks"] is False


def test_keys_come_from_an_optional_secret(container: dict[str, Any]) -> None:
    secrets = {
        variable["name"]: variable["valueFrom"]["secretKeyRef"]
        for variable in container["env"]
        if "secretKeyRef" in variable.get("valueFrom", {})
    }
    assert secrets == {
        "SCENE_API_KEY": {"name": "scene", "key": "api-key", "optional": True},
        "SCENE_ADMIN_KEY": {"name": "scene", "key": "admin-key", "optional": True},
    }


def test_the_grace_period_covers_the_end_of_the_service(
    manifests: Manifests, pod: dict[str, Any], container: dict[str, Any]
) -> None:
    def seconds(name: str) -> float:
        value = config(manifests).get(f"SCENE_{name.upper()}")
        return float(value or Settings.model_fields[name].default)

    program, before = container["lifecycle"]["preStop"]["exec"]["command"]
    assert program == "sleep"
    end = math.ceil(int(before) + seconds("drain_seconds") + seconds("drain_timeout"))
    assert pod["terminationGracePeriodSeconds"] >= end + 5


def test_selectors_match_the_labels(manifests: Manifests) -> None:
    deployment = manifests["Deployment", "scene"]
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert labels == {"app.kubernetes.io/name": "scene"}
    assert deployment["spec"]["selector"]["matchLabels"] == labels
    for name in ("scene", "scene-replicas"):
        assert manifests["Service", name]["spec"]["selector"] == labels
    budget = manifests["PodDisruptionBudget", "scene"]["spec"]
    assert budget["selector"]["matchLabels"] == labels
    policy = manifests["NetworkPolicy", "scene"]["spec"]
    assert policy["podSelector"]["matchLabels"] == labels
    for constraint in deployment["spec"]["template"]["spec"].get("topologySpreadConstraints", ()):
        assert constraint["labelSelector"]["matchLabels"] == labels


def test_containers_have_no_privileges_and_a_read_only_root(
    manifests: Manifests, pod: dict[str, Any]
) -> None:
    assert pod["automountServiceAccountToken"] is False
    assert pod["serviceAccountName"] == manifests["ServiceAccount", "scene"]["metadata"]["name"]
    assert pod["securityContext"]["runAsNonRoot"] is True
    assert pod["securityContext"]["runAsUser"] == 10001
    assert pod["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert not {"hostNetwork", "hostPID", "hostIPC"} & pod.keys()
    for container in [*pod["containers"], *pod.get("initContainers", ())]:
        assert container["securityContext"] == {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        }
        assert {"cpu", "memory"} <= container["resources"]["requests"].keys()
        assert "memory" in container["resources"]["limits"]


def test_writable_folders_have_a_limit(
    manifests: Manifests, pod: dict[str, Any], container: dict[str, Any]
) -> None:
    volumes = {volume.pop("name"): volume for volume in pod["volumes"]}
    mounts = {mount["mountPath"]: volumes[mount["name"]] for mount in container["volumeMounts"]}
    assert size(mounts["/tmp"]["emptyDir"]["sizeLimit"]) <= 2**30
    assert "hostPath" not in {kind for volume in volumes.values() for kind in volume}
    data = config(manifests)
    if "://" in data["SCENE_STORE"]:
        # The service makes this folder itself, because it needs a folder of its own.
        cache = Path(data["SCENE_STORE_CACHE"])
        limit = size(mounts[str(cache.parent)]["emptyDir"]["sizeLimit"])
        assert limit > int(data["SCENE_STORE_CACHE_BYTES"])
    elif data["SCENE_STORE"] != "/srv/scene/model_store":
        assert "persistentVolumeClaim" in mounts[data["SCENE_STORE"]]


def test_the_network_policy_opens_the_ports_in_use(
    manifests: Manifests, container: dict[str, Any]
) -> None:
    policy = manifests["NetworkPolicy", "scene"]["spec"]
    assert set(policy["policyTypes"]) == {"Ingress", "Egress"}
    (entry,) = policy["ingress"]
    assert [port["port"] for port in entry["ports"]] == [container["ports"][0]["containerPort"]]
    out = {(port["port"], port["protocol"]) for rule in policy["egress"] for port in rule["ports"]}
    dns = {(53, "UDP"), (53, "TCP")}
    is_remote = "://" in config(manifests)["SCENE_STORE"]
    assert out == (dns | {(443, "TCP")} if is_remote else dns)


def test_an_update_and_a_drained_node_leave_replicas(manifests: Manifests) -> None:
    rolling = manifests["Deployment", "scene"]["spec"]["strategy"]["rollingUpdate"]
    assert rolling["maxUnavailable"] == 0
    assert manifests["PodDisruptionBudget", "scene"]["spec"]["maxUnavailable"] == 1


def test_images_have_a_digest_except_on_a_laptop(pod: dict[str, Any], overlay: str) -> None:
    images = {one["image"] for one in [*pod["containers"], *pod.get("initContainers", ())]}
    (image,) = images
    if overlay == "local":
        assert image == "scene-boltzmann:local"
    else:
        assert re.fullmatch(r"registry\.example/scene-boltzmann@sha256:[0-9a-f]{64}", image)


def test_the_autoscaler_alone_sets_the_number_of_replicas(manifests: Manifests) -> None:
    scaler = manifests.get(("HorizontalPodAutoscaler", "scene"))
    deployment = manifests["Deployment", "scene"]
    assert ("replicas" in deployment["spec"]) == (scaler is None)
    if scaler:
        target = scaler["spec"]["scaleTargetRef"]
        assert (target["kind"], target["name"]) == ("Deployment", deployment["metadata"]["name"])
        assert scaler["spec"]["minReplicas"] >= 2


def test_prometheus_sends_the_key(folder: Path, rendered: dict[str, str]) -> None:
    manifests = by_name(rendered["everything"])
    deployment = manifests["Deployment", "scene"]["spec"]["template"]
    (container,) = deployment["spec"]["containers"]
    monitor = manifests["PodMonitor", "scene"]["spec"]
    assert monitor["selector"]["matchLabels"] == deployment["metadata"]["labels"]
    # The job of the alerts.
    assert deployment["metadata"]["labels"][monitor["jobLabel"]] == "scene"
    (endpoint,) = monitor["podMetricsEndpoints"]
    assert endpoint["port"] == container["ports"][0]["name"]
    (key,) = [one for one in container["env"] if one["name"] == "SCENE_API_KEY"]
    secret = key["valueFrom"]["secretKeyRef"]
    assert endpoint["authorization"]["credentials"] == {k: secret[k] for k in ("name", "key")}

    scrape = yaml.safe_load((folder / "monitoring" / "scrape.yaml").read_text("utf-8"))
    (job,) = scrape["scrape_configs"]
    assert job["job_name"] == "scene"
    assert Path(job["authorization"]["credentials_file"]).name == secret["key"]
    (discovery,) = job["dns_sd_configs"]
    assert discovery["port"] == container["ports"][0]["containerPort"]
    (name,) = discovery["names"]
    replicas = manifests["Service", name.partition(".")[0]]["spec"]
    assert replicas["clusterIP"] == "None"


def test_prometheus_of_compose_reads_the_key_from_a_file(repository: Path) -> None:
    services = yaml.safe_load((repository / "docker-compose.yml").read_text("utf-8"))["services"]
    text = (repository / "deploy" / "monitoring" / "prometheus.yml").read_text("utf-8")
    (job,) = yaml.safe_load(text)["scrape_configs"]
    key = job["authorization"]["credentials_file"]
    assert f"${{API_KEY_FILE:-/dev/null}}:{key}:ro" in services["prometheus"]["volumes"]
