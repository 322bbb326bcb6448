"""The image and its compose file: linted, valid, and in agreement with the service's settings."""

from __future__ import annotations

import re
from collections.abc import Callable
from configparser import ConfigParser
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from app.settings import Settings
from deploy.image import first_base, pip_settings
from tests.conftest import run_program

pytestmark = pytest.mark.system


@dataclass(frozen=True, slots=True)
class Instruction:
    """One instruction: `COPY --from=a b c` has the fields COPY, {"from": "a"} and "b c"."""

    keyword: str
    flags: dict[str, str]
    argument: str


def split_stages(dockerfile: str) -> dict[str, list[Instruction]]:
    """Return the instructions of each stage by stage name, in the order of the file."""
    text = re.sub(r"^\s*#.*\n", "", dockerfile, flags=re.MULTILINE)
    stages: dict[str, list[Instruction]] = {}
    for line in filter(str.strip, re.sub(r"\\[ \t]*\n", " ", text).splitlines()):
        keyword, rest = line.split(maxsplit=1)
        flags, argument = re.fullmatch(r"((?:--\S+ +)*)(.*)", rest).groups()
        if keyword == "FROM":
            current = stages.setdefault(argument.split(" AS ")[1], [])
        pairs = re.findall(r"--([\w-]+)=(\S+)", flags)
        current.append(Instruction(keyword, dict(pairs), argument.strip()))
    return stages


@pytest.fixture(scope="module")
def stages(repository: Path) -> dict[str, list[Instruction]]:
    return split_stages((repository / "Dockerfile").read_text("utf-8"))


def built(compose: dict[str, Any]) -> list[dict[str, Any]]:
    """The services that run an image of this repository."""
    services = [service for service in compose["services"].values() if "build" in service]
    assert len(services) == 2
    return services


def arguments(stage: list[Instruction], keyword: str) -> list[str]:
    return [i.argument for i in stage if i.keyword == keyword]


@pytest.mark.parametrize(
    ("tool", "arguments"),
    [
        ("hadolint", ["--failure-threshold=style", "Dockerfile"]),
        ("shellcheck", [".ci/run"]),
        ("check-jsonschema", ["--builtin-schema=vendor.compose-spec", "docker-compose.yml"]),
    ],
)
def test_files_have_no_lint(
    require_system_tool: Callable[[str], Path], tool: str, arguments: list[str]
) -> None:
    run_program(require_system_tool(tool), *arguments)


@pytest.mark.parametrize("name", ["runtime", "ray", "train"])
def test_final_stages_run_as_a_fixed_unprivileged_user(
    stages: dict[str, list[Instruction]], compose: dict[str, Any], name: str
) -> None:
    (user,) = arguments(stages[name], "USER")
    assert re.fullmatch(r"[1-9]\d{3,}:[1-9]\d{3,}", user)
    assert {service["user"] for service in built(compose)} == {user}


def test_the_default_stage_serves_and_knows_nothing_of_training(
    stages: dict[str, list[Instruction]],
) -> None:
    assert list(stages)[-1] == "runtime"
    (command,) = arguments(stages["runtime"], "CMD")
    assert command.endswith('&& exec python -m app"]')
    assert "/health/ready" in arguments(stages["runtime"], "HEALTHCHECK")[0]
    assert not any("training" in i.argument + str(i.flags) for i in stages["runtime"])


def test_every_variable_given_to_the_service_is_one_it_reads(
    stages: dict[str, list[Instruction]], compose: dict[str, Any]
) -> None:
    known = {f"SCENE_{field.upper()}" for field in Settings.model_fields}
    in_image = set(re.findall(r"\bSCENE_\w+(?==)", " ".join(arguments(stages["runtime"], "ENV"))))
    in_compose = set(compose["services"]["scene"]["environment"])
    assert {"SCENE_HOST", "SCENE_PORT", "SCENE_STORE"} <= in_image <= known
    assert in_compose <= known


@pytest.mark.parametrize("name", ["proxy", "scene", "train", "prometheus", "grafana"])
def test_services_are_confined(compose: dict[str, Any], name: str) -> None:
    service = compose["services"][name]
    assert re.fullmatch(r"[1-9]\d+:\d+", service["user"])
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert "no-new-privileges:true" in service["security_opt"]
    assert {"memory", "pids"} <= service["deploy"]["resources"]["limits"].keys()
    assert not {"privileged", "cap_add", "devices", "pid", "ipc", "network_mode"} & service.keys()
    assert all("/var/run" not in volume for volume in service["volumes"])
    if name in ("prometheus", "grafana"):
        return
    assert service["logging"]["driver"] == "json-file"
    assert {"max-size", "max-file"} <= service["logging"]["options"].keys()
    (temporary,) = service["tmpfs"]
    assert {"noexec", "nosuid", "nodev"} <= set(temporary.partition(":")[2].split(","))
    assert re.search(r"\bsize=\d+m\b", temporary)


def test_ports_are_published_on_this_machine_only(compose: dict[str, Any]) -> None:
    ports = {name: service.get("ports", []) for name, service in compose["services"].items()}
    assert ports["scene"] == ports["train"] == []
    for name, start in (
        ("proxy", "${PUBLISH_ADDRESS:-127.0.0.1}:"),
        ("prometheus", "127.0.0.1:"),
        ("grafana", "127.0.0.1:"),
    ):
        (port,) = ports[name]
        assert port.startswith(start)


def pins(repository: Path, lock: str) -> set[str]:
    text = (repository / f"requirements{lock}.lock").read_text("utf-8")
    return {line for line in text.splitlines() if "==" in line and not line.startswith("#")}


@pytest.mark.parametrize("lock", ["", "-ray", "-training", "-dev"])
def test_locks_pin_every_package_by_hash_and_name_no_index(repository: Path, lock: str) -> None:
    """`pip install --require-hashes` refuses a package without a hash."""
    text = (repository / f"requirements{lock}.lock").read_text("utf-8").replace("\\\n", "")
    for line in text.splitlines()[1:]:
        pin = r"[a-z0-9-]+==[0-9][0-9a-z.]*( ; .+?)?"
        assert re.fullmatch(rf"{pin}(\s+--hash=sha256:[0-9a-f]{{64}})+\s*", line), line
    assert not any(pin.startswith("torch==") for pin in pins(repository, lock))


def test_only_torch_may_come_from_another_index(repository: Path) -> None:
    assert pins(repository, "-torch") == {"torch==2.13.0"}
    for file in ("Makefile", "Dockerfile"):
        text = (repository / file).read_text("utf-8").replace("\\\n", " ")
        assert "--extra-index-url" not in text
        for line in text.splitlines():
            if "install" in line and "--index-url" in line:
                assert "--no-deps" in line


def test_the_base_image_may_have_a_digest() -> None:
    assert (
        first_base("# FROM no\nFROM python:3@sha256:ab AS base\nFROM base") == "python:3@sha256:ab"
    )


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
