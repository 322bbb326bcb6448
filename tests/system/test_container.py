"""The image and its compose file: linted, valid, and in agreement with the service's settings."""

import os
import re
import sys
from configparser import ConfigParser
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.specifiers import SpecifierSet

from app.registry import AliasTarget, Store, load_model_set
from app.registry.references import aliases_to_bytes
from app.settings import Settings
from deploy.image import PACKAGES, ImageError, check_packages, first_base, pip_settings
from tests.conftest import run_program

pytestmark = pytest.mark.system


def split_stages(dockerfile: str) -> dict[str, str]:
    """Return the instructions of each stage by its name, in the order of the file."""
    text = re.sub(r"^ *#.*\n", "", dockerfile, flags=re.MULTILINE)
    parts = re.split(r"^FROM .* AS (\S+)\n", text, flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


@pytest.fixture(scope="module")
def stages(repository: Path) -> dict[str, str]:
    return split_stages((repository / "Dockerfile").read_text("utf-8"))


@pytest.mark.parametrize("name", ["runtime", "ray", "train"])
def test_stages_have_no_root(stages: dict[str, str], compose: dict[str, Any], name: str) -> None:
    (user,) = re.findall(r"^USER ([1-9]\d{3,}:[1-9]\d{3,})$", stages[name], re.MULTILINE)
    built = [service for service in compose["services"].values() if "build" in service]
    assert [service["user"] for service in built] == [user] * 3


def test_the_default_stage_serves(stages: dict[str, str]) -> None:
    assert list(stages)[-1] == "runtime"
    assert '&& exec python -m app"]' in stages["runtime"]
    check = stages["runtime"].split("HEALTHCHECK")[1]
    assert "SCENE_HEALTH_PORT" in check
    assert "/health/ready" in check
    assert "training" not in stages["runtime"]


def test_variables_are_settings(stages: dict[str, str], compose: dict[str, Any]) -> None:
    known = {f"SCENE_{field.upper()}" for field in Settings.model_fields}
    in_image = set(re.findall(r"\bSCENE_\w+(?==)", stages["runtime"]))
    assert {"SCENE_HOST", "SCENE_PORT", "SCENE_HEALTH_PORT", "SCENE_STORE"} <= in_image <= known
    assert compose["services"]["scene"]["environment"].keys() <= known


def test_the_proxy_checks_the_health_port(stages, compose, configuration):
    port = compose["services"]["scene"]["environment"]["SCENE_HEALTH_PORT"]
    assert f"SCENE_HEALTH_PORT={port} " in stages["runtime"]
    assert f'check port "${{PROXY_HEALTH_PORT-{port}}}"' in configuration.read_text("utf-8")


@pytest.mark.parametrize(
    "name", ["proxy", "shipped-models", "scene", "train", "prometheus", "grafana"]
)
def test_services_are_confined(compose: dict[str, Any], name: str) -> None:
    service = compose["services"][name]
    assert re.fullmatch(r"[1-9]\d+:\d+", service["user"])
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert {"memory", "pids"} <= service["deploy"]["resources"]["limits"].keys()
    assert not {"privileged", "cap_add", "devices", "pid", "ipc", "network_mode"} & service.keys()
    assert all("/var/run" not in volume for volume in service["volumes"])


def test_training_writes_to_its_volumes(stages: dict[str, str], compose: dict[str, Any]) -> None:
    """Under a read-only root, a command can write to volumes and to /tmp only."""
    stage = stages["train"]
    volumes = compose["services"]["train"]["volumes"]
    mounted = dict(re.search(r":(/[^:]+)(:ro)?$", volume).groups() for volume in volumes)
    settings = dict(re.findall(r"([A-Z_]+)=(\S+)", stage.split("ENV ")[1]))
    (folder,) = re.findall(r"^WORKDIR (\S+)$", stage, re.MULTILINE)
    assert mounted == {folder: None, settings["SCENE_STORE"]: None, "/data": ":ro"}
    assert f"install -d -o 10001 -g 10001 {folder}\n" in stage
    assert "COPY --chown=10001:10001 model_store ./model_store\n" in stage
    assert settings["NUMBA_CACHE_DIR"].startswith(f"{folder}/")
    assert settings["PYTHONPATH"] == "/srv/scene"  # `python -m training` from another folder


def test_the_context_has_every_copied_file(stages: dict[str, str], repository: Path) -> None:
    ignored, *included = (repository / ".dockerignore").read_text("utf-8").split("\n!")
    included[-1] = included[-1].partition("\n")[0]
    assert ignored.endswith("*")
    copied = re.findall(r"(?m)^COPY (?!--from)(?:--\S+ )?(.+) \S+$", "".join(stages.values()))
    assert {file for files in copied for file in files.split()} == set(included)


def test_ports_are_published_on_this_machine_only(compose: dict[str, Any]) -> None:
    ports = {name: service.get("ports", []) for name, service in compose["services"].items()}
    assert ports["scene"] == ports["train"] == []
    assert ports["proxy"][0].startswith("${PUBLISH_ADDRESS:-127.0.0.1}:")
    assert all(ports[name][0].startswith("127.0.0.1:") for name in ("prometheus", "grafana"))


def test_an_upgrade_copies_the_shipped_models(stages, compose, tmp_path, repository):
    """The command of the compose file, on the paths of the image."""
    services = compose["services"]
    copy, scene = services["shipped-models"], services["scene"]
    assert scene["depends_on"]["shipped-models"]["condition"] == "service_completed_successfully"
    assert copy["volumes"] == scene["volumes"] == ["models:/srv/scene/models"]
    assert scene["environment"]["SCENE_STORE"] == "${SCENE_STORE:-/srv/scene/models}"
    assert copy["image"] == scene["image"]
    assert "RUN install -d -o 10001 -g 10001 models" in stages["runtime"]
    (tmp_path / "model_store").symlink_to(repository / "model_store")
    old = AliasTarget(name="indoor-triway", version="1.0.0")
    (tmp_path / "models" / "indoor-triway" / "1.0.0").mkdir(parents=True)
    manifest = tmp_path / "models" / "indoor-triway" / "1.0.0" / "manifest.json"
    manifest.write_text('{"format": 1}', "utf-8")
    (tmp_path / "models" / "aliases.json").write_bytes(aliases_to_bytes({"default": old}))
    program, *arguments = copy["command"]
    assert program == "python"
    environment = os.environ | {"PYTHONPATH": str(repository)}
    run_program(sys.executable, *arguments, cwd=tmp_path, env=environment)
    release = Store(repository / "model_store")
    models = load_model_set(Store(tmp_path / "models"), release=release)
    assert models.is_outdated("default"), "so the shipped default answers"
    assert models.resolve(str(models.shipped.default)).key == release.resolve("default")
    assert list(models.failures) == [("indoor-triway", "1.0.0")]


def pins(repository: Path, lock: str) -> set[str]:
    text = (repository / f"requirements{lock}.lock").read_text("utf-8")
    return {line for line in text.splitlines() if "==" in line and not line.startswith("#")}


@pytest.mark.parametrize("lock", ["", "-ray", "-training", "-dev", "-torch-cpu"])
def test_locks_pin_every_package_by_hash_and_name_no_index(repository: Path, lock: str) -> None:
    """`pip install --require-hashes` refuses a package without a hash."""
    text = (repository / f"requirements{lock}.lock").read_text("utf-8").replace("\\\n", "")
    for line in text.splitlines()[1:]:
        pin = r"[a-z0-9-]+==[0-9][0-9a-z.]*( ; .+?)?"
        assert re.fullmatch(rf"{pin}(\s+--hash=sha256:[0-9a-f]{{64}})+\s*", line), line
    has_torch = any(pin.startswith("torch==") for pin in pins(repository, lock))
    assert has_torch == (lock == "-torch-cpu")


def test_packages_accept_the_first_release_of_each_python() -> None:
    """Debian 12 has Python 3.11.2, and a package that needs 3.11.5 stops its `make test`."""
    refused = [
        f"{package.name} {package.version}: Python {required}"
        for package in metadata.distributions()
        if (required := package.metadata["Requires-Python"])
        and not all(SpecifierSet(required).contains(f"3.{minor}.0") for minor in (11, 12, 13))
    ]
    assert not refused


def test_only_torch_may_come_from_another_index(repository: Path) -> None:
    assert pins(repository, "-torch") == {"torch==2.13.0"}
    assert pins(repository, "-torch-cpu") == {"torch==2.13.0 \\"}
    for file in ("Makefile", "Dockerfile"):
        text = (repository / file).read_text("utf-8").replace("\\\n", " ")
        assert "--extra-index-url" not in text
        for line in text.splitlines():
            if "install" in line and "--index-url" in line:
                assert "--no-deps --require-hashes" in line


def test_the_image_has_the_packages_of_its_lock_file() -> None:
    installed = sorted({*run_program(sys.executable, "-c", PACKAGES).stdout.split()})
    lock = "".join(f"{pin} \\\n    --hash=sha256:00\n" for pin in installed)
    check_packages("\n".join(installed), lock)
    for listed in (installed[1:], [*installed, "evil==1.0"]):
        with pytest.raises(ImageError, match="the image and requirements"):
            check_packages("\n".join(listed), lock)


def test_the_base_image_may_have_a_digest() -> None:
    text = "# FROM no\nFROM python:3@sha256:ab AS base\nFROM base"
    assert first_base(text) == "python:3@sha256:ab"


def test_settings_of_pip_become_one_file_and_its_paths() -> None:
    text, paths = pip_settings(
        ":env:.cert='/certs/all.pem'\n"
        "global.extra-index-url='\\nfile:///packages/simple\\nhttps://index.example/simple'\n"
        "install.find-links='/wheels'\n"
    )
    parsed = ConfigParser()
    parsed.read_string(text)
    assert parsed["global"]["cert"] == "/certs/all.pem"
    assert parsed["global"]["extra-index-url"].split()[1] == "https://index.example/simple"
    assert parsed["install"]["find-links"] == "/wheels"
    assert paths == ["/certs/all.pem", "/packages", "/wheels"]
