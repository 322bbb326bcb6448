"""What a robot installs: one package, whose blocking client is written from the other."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

from scripts import sync_client


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
