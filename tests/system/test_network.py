"""`docs/network.md`: the service in one network namespace, the client in another."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY, FindTool, run_program
from tests.services import wait_until

pytestmark = pytest.mark.system

KEY = "incorrect-zebra-capacitor-nail"
PAGE = (REPOSITORY / "docs" / "network.md").read_text("utf-8")
PC, ROBOT = (f"scene-{name}-{os.getpid()}" for name in ("pc", "robot"))
ADDRESSES = {PC: ("192.168.1.20/24", "fd00::20/64"), ROBOT: ("192.168.1.30/24", "fd00::30/64")}


@pytest.fixture(scope="module", autouse=True)
def network(find_tool: FindTool) -> Iterator[None]:
    """Two machines with one cable. No packet leaves the two namespaces."""
    os.environ["PATH"] += os.pathsep + "/usr/sbin"
    ip = find_tool("ip")
    if os.geteuid() != 0 and os.environ.get("REQUIRE_SYSTEM") != "1":
        pytest.skip("only root can make network namespaces")
    with ExitStack() as stack:
        for machine in ADDRESSES:
            run_program(ip, "netns", "add", machine)
            stack.callback(run_program, ip, "netns", "delete", machine)
        cable = ("add", "eth0", "netns", PC, "type", "veth", "peer", "eth0", "netns", ROBOT)
        run_program(ip, "link", *cable)
        for machine, addresses in ADDRESSES.items():
            for address in addresses:
                nodad = ["nodad"] if ":" in address else []
                run_program(ip, "-n", machine, "address", "add", address, "dev", "eth0", *nodad)
            for link in ("lo", "eth0"):
                run_program(ip, "-n", machine, "link", "set", link, "up")
        yield


def command(words: str) -> str:
    """Return the block of the page that contains some words, with a real key."""
    (block,) = (block for block in re.findall(r"(?:^    .+\n)+", PAGE, re.M) if words in block)
    return block.replace("=KEY", f"={KEY}")


def on(machine: str, script: str) -> list[str]:
    return ["ip", "netns", "exec", machine, "bash", "-euc", script]


@pytest.mark.parametrize(
    ("host", "urls"),
    [
        ("0.0.0.0", ["http://192.168.1.20:8000"]),
        ("::", ["http://192.168.1.20:8000", "http://[fd00::20]:8000"]),
    ],
)
def test_a_robot_is_answered(tmp_path: Path, host: str, urls: list[str]) -> None:
    environment = {name: os.environ[name] for name in os.environ if not name.startswith("SCENE_")}
    environment["PATH"] = f"{Path(sys.executable).parent}:{environment['PATH']}"
    serve = command("python -m app").replace("0.0.0.0", host)
    serve = serve.replace(".venv/bin/python", f"exec {sys.executable}")
    ask, log = command("scene missing"), tmp_path / "log"
    with log.open("w") as stream:
        service = subprocess.Popen(on(PC, serve), cwd=REPOSITORY, env=environment, stderr=stream)
    try:
        wait_until(lambda: "ready: " in log.read_text() or service.poll() is not None, log)
        wait_until(lambda: "from other machines: " in log.read_text(), log)
        assert f"from other machines: {urls[0]}/" in log.read_text()
        assert "SCENE_API_KEY is not set" not in log.read_text()
        for url in urls:
            there = ask.replace("http://192.168.1.20:8000", url)
            answer = run_program(*on(ROBOT, there), env=environment, status=0)
            assert "pillow" in answer.stdout
            without = there.replace(f" SCENE_API_KEY={KEY}", "")
            refused = run_program(*on(ROBOT, without), env=environment, status=1)
            assert "unauthorized" in refused.stderr
            header = "curl -s -H 'Host: evil.example' " + url
            assert "SCENE_ALLOWED_HOSTS" in run_program(*on(ROBOT, header)).stdout
    finally:
        service.send_signal(signal.SIGINT)
        service.wait(timeout=30)
