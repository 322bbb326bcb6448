"""The package of the Python client, also on Python 3.10, generated clients, and the C++ client."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import app
from app.registry.manifest import FORMAT
from scripts import sync_client
from tests.client import callers
from tests.conftest import REPOSITORY, FindTool, run_program
from tests.services import LiveService


def test_the_blocking_client_is_up_to_date():
    assert sync_client.TARGET.read_text("utf-8") == sync_client.generated(), "run `make format`"


@pytest.mark.parametrize(
    ("path", "pattern"),
    [
        ("clients/python/scene_client/__init__.py", r'__version__ = "(.+)"'),
        ("clients/cpp/scene_client.hpp", r"^// C\+\+17 client (\S+) of "),
        ("clients/ros2/scene_reasoning/package.xml", r"<version>(.+)</version>"),
        ("clients/ros2/scene_reasoning/setup.py", r'version="(.+)"'),
        ("clients/ros2/scene_reasoning_msgs/package.xml", r"<version>(.+)</version>"),
        ("Dockerfile", r"org\.opencontainers\.image\.version=(\S+)"),
        ("docs/operations.md", r"--branch v(\S+)"),
        ("docs/upgrading.md", rf"^\| (\S+) \| {FORMAT} \| \1; "),
        ("CHANGELOG.md", r"^## (\d\S*)"),
    ],
)
def test_every_file_states_the_version(repository: Path, path: str, pattern: str) -> None:
    match = re.search(pattern, (repository / path).read_text("utf-8"), re.MULTILINE)
    assert match[1] == app.__version__


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A copy: pip leaves its build folder in the source, and takes old modules from it."""
    ignored = shutil.ignore_patterns("build", "*.egg-info")
    return shutil.copytree(REPOSITORY / "clients/python", tmp_path / "source", ignore=ignored)


def test_the_wheel_has_only_the_client(source: Path, tmp_path: Path) -> None:
    command = (sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation")
    subprocess.run([*command, "-w", tmp_path, source], check=True, timeout=120)
    (wheel,) = tmp_path.glob("scene_client-*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    modules = {str(path.relative_to(source)) for path in source.glob("scene_client/**/*.py")}
    assert {name for name in names if name.endswith(".py")} == modules
    assert all(name.startswith("scene_client") for name in names)
    assert "scene_client/py.typed" in names


HEAVY = (
    *("fastapi", "matplotlib", "numba", "numpy", "prometheus_client", "pydantic_settings"),
    *("rapidfuzz", "safetensors", "starlette", "torch", "uvicorn"),
)

PROGRAM = f"""
import sys
for module in {HEAVY!r}:
    sys.modules[module] = None  # importing it raises ImportError
import scene_client, scene_client.command, scene_client.schemas, scene_client.vision_msgs
with scene_client.Client("http://127.0.0.1:9", retries=0) as scene:
    assert not scene.is_ready()
    try:
        scene.missing(["bed"])
    except scene_client.UnreachableError:
        pass
try:
    scene_client.OfflineClient()
except ImportError as error:
    print(error)
"""


def test_the_client_needs_no_package_of_the_service() -> None:
    done = run_program(sys.executable, "-W", "error", "-c", PROGRAM)
    # An offline client says which packages it needs.
    assert "pip install '.[service]' in the repository" in done.stdout


ON_A_ROBOT = """
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
from scene_client import Home
from scene_reasoning.detections import Converter, Transform
from scene_reasoning.home_thread import HomeThread

message = json.loads(Path("clients/ros2/detections.json").read_text("utf-8"))
with Client(sys.argv[1], timeout=30) as client:
    assert client.missing(["bed"]).missing == asyncio.run(ask()).missing
    thread, pose = HomeThread(Home(client)), (0.0, 0.0, 0.0)
    detections = Converter().detections(message, Transform())
    for second in range(4):
        thread.ask(lambda home: home.update(detections, pose, second)).result()
    things = thread.ask(Home.things).result()
    thread.close()
print(json.dumps(len(things)))
"""


@pytest.mark.slow
@pytest.mark.system
def test_python_310(source: Path, tmp_path: Path, live: LiveService) -> None:
    """Client, command and parts of the node, installed as on a robot with ROS 2 Humble."""
    pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv")
    installed = sorted(pyenv.glob("versions/3.10.*/bin/python3.10"))
    found = installed[0] if installed else shutil.which("python3.10")
    if found is None:
        pytest.skip("Python 3.10 is not installed")
    run_program(found, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv/bin/python"
    pip = ("-m", "pip", "--disable-pip-version-check", "install", "-qq")
    run_program(python, *pip, source, timeout=300)
    scene = ("-m", "scene_client", "missing", "bed", "lamp", "--json", "--url", live.url)
    done = run_program(python, *scene)
    assert json.loads(done.stdout)["missing"]
    plain = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = run_program(python, "-W", "error", "-c", ON_A_ROBOT, live.url, env=plain)
    assert json.loads(done.stdout) == 8


GENERATED = """
import importlib, json, pkgutil, sys
import generated
from generated import Client, models
from generated.api import questions

for module in pkgutil.walk_packages(generated.__path__, "generated."):
    importlib.import_module(module.name)
client = Client(sys.argv[1])
for name, fields in json.loads(sys.argv[2]).items():
    request = getattr(models, name.title() + "Request").from_dict(fields)
    answer = getattr(questions, name).sync(client=client, body=request)
    print(json.dumps([name, answer.to_dict()]))
"""


@pytest.mark.slow
def test_a_generated_client_asks_each_question(live: LiveService, tmp_path: Path) -> None:
    pytest.importorskip("openapi_python_client")
    (tmp_path / "openapi.json").write_bytes(live.client.get("/openapi.json").content)
    # The generator formats its code with ruff.
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    run_program(
        *(sys.executable, "-m", "openapi_python_client", "generate", "--path", "openapi.json"),
        *("--output-path", "generated", "--meta", "none", "--fail-on-warning"),
        cwd=tmp_path,
        env=os.environ | {"PATH": path},
    )
    lamp = {"label": "lamp", "id": "l", "position": {"x": 1.0, "y": 0.0, "z": 0.5}}
    scene = {"objects": ["bed", lamp], "relations": [["l", "left", "bed"]], "seed": 7}
    requests = dict.fromkeys(("relations", "missing", "outliers", "rooms", "generate"), scene)
    requests["where"] = {"label": "desk", "rooms": [{"id": "bedroom", "objects": ["bed", lamp]}]}
    command = (sys.executable, "-c", GENERATED, live.url, json.dumps(requests))
    done = run_program(*command, cwd=tmp_path)
    answers = dict(map(json.loads, done.stdout.splitlines()))
    assert answers.keys() == requests.keys()
    for question, answer in answers.items():
        expected = live.client.post(f"/{question}", json=requests[question]).json()
        assert answer == expected | {"request_id": answer["request_id"]}


@pytest.mark.slow
@pytest.mark.system
def test_generated_types_of_typescript_compile(
    live: LiveService, tmp_path: Path, find_tool: FindTool
) -> None:
    folder = shutil.copytree(REPOSITORY / "tests/client/typescript", tmp_path / "typescript")
    (folder / "openapi.json").write_bytes(live.client.get("/openapi.json").content)
    find_tool("node")
    run_program(find_tool("npm"), "ci", "--ignore-scripts", "--no-audit", "--no-fund", cwd=folder)
    programs = folder / "node_modules/.bin"
    types = ("openapi.json", "--output", "generated.ts", "--default-non-nullable=false")
    run_program(programs / "openapi-typescript", *types, cwd=folder)
    strict = ("--noEmit", "--strict", "--target", "es2022", "--module", "preserve")
    run_program(programs / "tsc", *strict, "questions.ts", cwd=folder)


GUIDE = (REPOSITORY / "docs" / "clients.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.system
def test_the_cpp_block_compiles_and_runs(url: str, tmp_path: Path, find_tool: FindTool) -> None:
    (program,) = re.findall(r"^```cpp\n(.*?)^```$", GUIDE, flags=re.MULTILINE | re.DOTALL)
    source = tmp_path / "block.cpp"
    source.write_text(program)
    block = callers.compiled(find_tool, source, tmp_path / "block")
    assert run_program(block, url).stdout.strip().strip('"')
    done = run_program(block, "robot:8000", status=2)
    assert (done.stdout, bool(done.stderr)) == ("", True)


@pytest.mark.slow
@pytest.mark.system
def test_the_cpp_example(url: str, tmp_path: Path, bridge: Path, find_tool: FindTool) -> None:
    # Asking for `bridge` leaves this test out where the libraries are missing.
    folder = shutil.copytree(REPOSITORY / "clients" / "cpp", tmp_path / "cpp")
    run_program(find_tool("make"), "-C", folder, "CXXFLAGS=-O0")
    example = folder / "example"
    answered = run_program(example, url, "30").stdout
    headings = re.findall(r"^\w.*:$", answered, re.MULTILINE)
    assert headings == [
        *("Missing:", "How they stand:", "Least fitting first:", "Which room it is:"),
        *("Where the phone is:", "A scene like it:"),
    ]
    for arguments, error in (
        (["http://127.0.0.1:9", "20"], "cannot reach http://127.0.0.1:9: connection refused"),
        (["robot:8000"], "the URL must begin with http://\n"),
        ([url, "soon"], "SECONDS must be a number, not 'soon'\n"),
    ):
        assert run_program(example, *arguments, status=2).stderr.startswith(error)
