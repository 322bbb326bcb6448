"""Fixtures and settings that every test shares."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

# One thread per test, as in a serving worker. So tests do not compete for cores, and results do not
# depend on the number of threads. This must come before the import of torch or numpy.
for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_variable] = "1"

import pytest
from hypothesis import HealthCheck, settings

REPOSITORY = Path(__file__).resolve().parent.parent

pytest_plugins = ["tests.services"]

FindTool = Callable[[str], Path]

# The default profile `ci` draws the same examples on every run. HYPOTHESIS_PROFILE=explore draws
# more and different examples.
# No profile measures time, because the machine may be busy.
untimed = settings(deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", untimed, derandomize=True)
settings.register_profile("explore", untimed, max_examples=2_000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def run_program(
    *command: str | Path, status: int = 0, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program in the repository with text in and out. Another exit status is an error."""
    options = {"cwd": REPOSITORY, "timeout": 600, **options}
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert done.returncode == status, done.stdout + done.stderr
    return done


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def anyio_backend() -> str:
    """Coroutine tests run on asyncio, like uvicorn."""
    return "asyncio"


@pytest.fixture(scope="session")
def find_tool() -> FindTool:
    """Return a function that finds a program, or skips the test if it is not installed.

    With REQUIRE_SYSTEM=1, as in continuous integration, a missing program fails the test. There, a
    skipped test would hide that the check did not run.
    """

    def find(name: str) -> Path:
        # Programs from wheels are in the interpreter's folder, which may be missing in PATH.
        # Debian has some programs in a folder of administrators.
        folders = (str(Path(sys.executable).parent), os.environ.get("PATH", ""), "/usr/sbin")
        search = os.pathsep.join(folders)
        if program := shutil.which(name, path=search):
            return Path(program)
        if os.environ.get("REQUIRE_SYSTEM") == "1":
            pytest.fail(f"{name} is not installed, and REQUIRE_SYSTEM=1 asks for it", pytrace=False)
        pytest.skip(f"{name} is not installed")

    return find


# The modules that take longest, the longest first.
LONGEST = (
    "tests/training/domain/test_own_scenes.py",
    "tests/examples/test_adaptation.py",
    "tests/training/research/test_benchmark.py",
    "tests/training/test_cli.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long modules first, then modules with slow tests, so that none is left at the end."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    ranks = {REPOSITORY / name: rank for rank, name in enumerate(LONGEST)}
    items.sort(key=lambda item: (ranks.get(item.path, len(LONGEST)), item.path not in slow))
