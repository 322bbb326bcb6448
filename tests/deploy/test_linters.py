"""The linters of other projects accept the configuration files for their programs."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import run_program

pytestmark = pytest.mark.system


@pytest.mark.parametrize(
    "command",
    [
        "promtool check rules deploy/monitoring/rules.yml",
        "promtool check config --syntax-only deploy/monitoring/prometheus.yml",
        "promtool check config --syntax-only deploy/kubernetes/monitoring/scrape.yaml",
        "haproxy -c -dW -f deploy/haproxy/haproxy.cfg",  # -dW: a warning is an error
        "hadolint --failure-threshold=style Dockerfile",
        "shellcheck .ci/run examples/adapt.sh examples/curl.sh",
        "check-jsonschema --builtin-schema=vendor.compose-spec docker-compose.yml",
    ],
)
def test_a_configuration_has_no_lint(
    require_system_tool: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    # Debian installs haproxy into a folder that is in the PATH of administrators only.
    monkeypatch.setenv("PATH", f"{os.environ['PATH']}{os.pathsep}/usr/sbin")
    monkeypatch.setenv("PROXY_BACKEND", "127.0.0.1:8000")
    program, *arguments = command.split()
    run_program(require_system_tool(program), *arguments)
