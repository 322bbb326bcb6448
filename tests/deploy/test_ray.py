"""Ray Serve: its configuration, and two replicas on this machine (with .venv-ray)."""

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from app.settings import Settings
from deploy.ray.run import descendants, environment
from tests.services import PATIENCE, LiveService, free_port, wait_until


@pytest.fixture(scope="module")
def folder(repository: Path) -> Path:
    return repository / "deploy" / "ray"


@pytest.fixture(scope="module")
def config(folder: Path) -> dict[str, Any]:
    return yaml.safe_load((folder / "serve.yaml").read_text("utf-8"))


@pytest.fixture(scope="module")
def cluster(folder: Path) -> dict[str, Any]:
    service, _ = yaml.safe_load_all((folder / "rayservice.yaml").read_text("utf-8"))
    return service["spec"]


@pytest.fixture(scope="module")
def pods(cluster: dict[str, Any]) -> list[dict[str, Any]]:
    spec = cluster["rayClusterConfig"]
    groups = [spec["headGroupSpec"], *spec["workerGroupSpecs"]]
    return [group["template"]["spec"] for group in groups]


def test_manifest_and_configuration_agree(config: dict[str, Any], cluster: dict[str, Any]) -> None:
    copy = yaml.safe_load(cluster["serveConfigV2"])
    assert config["http_options"]["host"] == "127.0.0.1"
    assert copy["http_options"]["host"] == "0.0.0.0"
    copy["http_options"]["host"] = "127.0.0.1"
    assert copy == config


def test_the_configuration_agrees_with_the_application(folder, repository, config):
    (application,) = config["applications"]
    module, _, attribute = application["import_path"].partition(":")
    source = (repository / f"{module.replace('.', '/')}.py").read_text("utf-8")
    assert re.search(rf"^{attribute} = ", source, re.MULTILINE)
    (deployment,) = application["deployments"]
    assert f'@serve.deployment(name="{deployment["name"]}")' in source
    assert application["route_prefix"] == "/"
    fields = Settings.model_fields
    assert config["http_options"]["port"] == fields["port"].default
    # The service answers with its own problems before Ray Serve refuses requests.
    most = deployment["max_ongoing_requests"] + deployment["max_queued_requests"]
    assert most >= fields["max_connections"].default
    assert deployment["graceful_shutdown_timeout_s"] > fields["drain_timeout"].default


def test_the_manifest_confines_pods_and_asks_for_a_token(cluster, pods, config, repository):
    spec = cluster["rayClusterConfig"]
    assert spec["authOptions"] == {"mode": "token"}
    lock = (repository / "requirements-ray.lock").read_text("utf-8")
    assert f"ray=={spec['rayVersion']} \\" in lock.splitlines()
    most = config["applications"][0]["deployments"][0]["autoscaling_config"]["max_replicas"]
    assert spec["workerGroupSpecs"][0]["maxReplicas"] == most
    for pod in pods:
        assert pod["securityContext"]["runAsNonRoot"]
        for container in (*pod["initContainers"], *pod["containers"]):
            assert container["resources"].keys() == {"requests", "limits"}
            confined = container["securityContext"]
            assert confined["readOnlyRootFilesystem"]
            assert not confined["allowPrivilegeEscalation"]
        ports = {port["name"]: port["containerPort"] for port in pod["containers"][0]["ports"]}
        assert ports["serve"] == config["http_options"]["port"]


def test_the_manifest_has_the_settings_of_the_local_start(pods: list[dict[str, Any]]) -> None:
    local = environment("scratch", "token")
    for pod in pods:
        settings = {one["name"]: one.get("value") for one in pod["containers"][0]["env"]}
        shared = settings.keys() & local.keys() - {"SCENE_API_KEY"}
        assert len(shared) >= 7
        assert {name: settings[name] for name in shared} == {name: local[name] for name in shared}


@pytest.fixture(scope="module")
def service(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """Two replicas of `deploy/ray/run.py` on a free port. No process remains after them."""
    python = repository / ".venv-ray" / "bin" / "python"
    if not python.with_name("ray").exists():
        pytest.skip("Ray is not installed; make ray installs it")
    port, log = free_port(), tmp_path_factory.mktemp("ray") / "log"
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("SCENE_", "RAY_"))}
    command = [python, repository / "deploy" / "ray" / "run.py", f"--port={port}", "--replicas=2"]
    with log.open("w") as stream:
        process = subprocess.Popen(command, env=inherited, stdout=stream, stderr=stream, text=True)

    def replicas() -> int:
        commands = descendants(process.pid).values()
        return sum(command.startswith("ray::ServeReplica") for command in commands)

    started: dict[int, str] = {}
    try:
        wait_until(lambda: "ready:" in log.read_text() or process.poll() is not None, seconds=600)
        assert process.poll() is None, log.read_text()
        wait_until(lambda: replicas() == 2)
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=PATIENCE) as client:
            yield LiveService(process, client, port, log)
    finally:
        started = descendants(process.pid)
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=PATIENCE)
    assert process.returncode == 0, log.read_text()
    assert "ending process" not in log.read_text()
    assert not [command for pid, command in started.items() if Path(f"/proc/{pid}").exists()]


@pytest.mark.slow
def test_answers_are_those_of_one_process(service: LiveService, shipped: LiveService) -> None:
    for _ in range(4):
        assert service.control() == shipped.control()
