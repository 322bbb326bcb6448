"""The client, installed as on a robot, on Python 3.10, the Python of ROS 2 Humble."""

import json
import os
import shutil
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY, run_program
from tests.services import LiveService

pytestmark = [pytest.mark.slow, pytest.mark.system]

PROGRAM = """
import asyncio, importlib, json, pkgutil, sys
from pathlib import Path
import scene_client
from scene_client import AsyncClient, Client

assert sys.version_info[:2] == (3, 10)
for module in pkgutil.walk_packages(scene_client.__path__, "scene_client."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)

async def ask():
    async with AsyncClient(sys.argv[1], timeout=30) as client:
        return await client.missing(["bed"])


package = Path("clients/ros2/scene_reasoning/scene_reasoning")
for module in package.glob("*.py"):
    compile(module.read_text("utf-8"), str(module), "exec")
sys.path.insert(0, str(package.parent))
from scene_reasoning.advisor import Advisor
from scene_reasoning.ghosts import ghosts
from scene_reasoning.latest import Latest

message = json.loads(Path("clients/ros2/detections.json").read_text("utf-8"))
with Client(sys.argv[1], timeout=30) as client:
    assert client.missing(["bed"]).missing == asyncio.run(ask()).missing
    latest = Latest(Advisor(client).advise)
    latest.see(message)
    while (outcome := latest.tick()) is None:
        pass
    latest.close()
advice = outcome.future.result()
print(json.dumps([sorted(advice.answers), len(ghosts(advice, 3))]))
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python 3.10 with the client and its packages, in an environment of its own."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv")
    installed = sorted(pyenv.glob("versions/3.10.*/bin/python3.10"))
    found = installed[0] if installed else shutil.which("python3.10")
    if found is None:
        pytest.skip("Python 3.10 is not installed")
    folder = tmp_path_factory.mktemp("python310")
    # A copy: pip leaves its build folder in the source.
    ignored = shutil.ignore_patterns("build", "*.egg-info")
    source = shutil.copytree(REPOSITORY / "clients/python", folder / "source", ignore=ignored)
    run_program(found, "-m", "venv", folder / "venv")
    program = folder / "venv/bin/python"
    pip = ("-m", "pip", "--disable-pip-version-check", "install", "-qq")
    run_program(program, *pip, source, timeout=300)
    return program


def test_clients_command_and_parts_of_the_node_work(python: Path, live: LiveService) -> None:
    scene = ("-m", "scene_client", "missing", "bed", "lamp", "--json", "--url", live.url)
    done = run_program(python, *scene)
    assert json.loads(done.stdout)["missing"]
    plain = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = run_program(python, "-W", "error", "-c", PROGRAM, live.url, env=plain)
    assert json.loads(done.stdout) == [["missing", "outliers"], 3]
