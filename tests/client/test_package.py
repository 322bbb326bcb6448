"""What a robot installs: one package, whose blocking client is written from the other."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

from scripts import sync_client
from tests.conftest import run_program


def test_the_blocking_client_is_up_to_date():
    assert sync_client.TARGET.read_text("utf-8") == sync_client.generated(), "run `make format`"


def test_the_wheel_holds_the_client_alone(repository: Path, tmp_path: Path):
    # A copy: pip leaves its build folder in the source, and takes old modules from it.
    ignored = shutil.ignore_patterns("build", "*.egg-info")
    source = shutil.copytree(repository / "clients" / "python", tmp_path / "source", ignore=ignored)
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


def test_the_client_works_where_nothing_of_the_service_is_installed() -> None:
    done = run_program(sys.executable, "-W", "error", "-c", PROGRAM)
    # An offline client says which packages it needs.
    assert "pip install '.[service]' in the repository" in done.stdout
