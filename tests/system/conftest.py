"""HAProxy with the shipped configuration, but for limits that a busy machine would exceed."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.conftest import FindTool
from tests.services import PATIENCE, free_port, is_ready, wait_until


@dataclass
class Proxy:
    port: int
    log: Path

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"


StartProxy = Callable[..., AbstractContextManager[Proxy]]
UNHURRIED = {
    "timeout connect 2s": "timeout connect 60s\n    timeout check 60s",
    "timeout queue 5s": "timeout queue 60s",
    "http_req_rate(10s)": "http_req_rate(1000s)",
}
"""Replaced texts of the configuration."""


@pytest.fixture(scope="session")
def configuration(repository: Path) -> Path:
    return repository / "deploy" / "haproxy" / "haproxy.cfg"


@pytest.fixture(scope="session")
def compose(repository: Path) -> dict[str, Any]:
    return yaml.safe_load((repository / "docker-compose.yml").read_text("utf-8"))


@pytest.fixture(scope="session")
def haproxy(find_tool: FindTool) -> StartProxy:
    """Return a function that starts the proxy; variables as in its configuration."""
    program = find_tool("haproxy")

    @contextmanager
    def start(configuration: Path, log: Path, **variables: str) -> Iterator[Proxy]:
        port, unhurried = free_port(), log.with_suffix(".cfg")
        text = configuration.read_text("utf-8")
        for shipped, replacement in UNHURRIED.items():
            assert text.count(shipped) == 1
            text = text.replace(shipped, replacement)
        unhurried.write_text(text, "utf-8")
        with log.open("w") as output:
            process = subprocess.Popen(
                [program, "-db", "-f", unhurried],
                env=os.environ | {"PROXY_LISTEN": f"127.0.0.1:{port}", **variables},
                stdout=output,
                stderr=subprocess.STDOUT,
            )
        try:
            wait_until(lambda: is_ready(port), log)
            yield Proxy(port, log)
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE)

    return start
