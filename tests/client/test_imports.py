"""A robot that asks installs neither torch nor FastAPI."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HEAVY = (
    "fastapi",
    "matplotlib",
    "numba",
    "numpy",
    "prometheus_client",
    "pydantic_settings",
    "rapidfuzz",
    "safetensors",
    "starlette",
    "torch",
    "uvicorn",
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


def test_the_client_works_where_nothing_of_the_service_is_installed(repository: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", PROGRAM],
        cwd=repository,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    # Whoever wants answers without a service is told what that takes.
    assert "pip install '.[service]' in the repository" in done.stdout
