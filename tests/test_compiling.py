"""Compiled loops between processes: never those of other sources, and in a folder of our own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from app import compiling

# A package with loops whose results depend on other files in every way that there is.
FILES = {
    "__init__": "",
    "inference/numbers": "WEIGHT = 2.0\n",
    "inference/tuples": """
from typing import NamedTuple
class Pair(NamedTuple):
    a: float
    b: float
""",
    "inference/helper": """
from app.compiling import compiled, inlined
@compiled
def called(x):
    return x + 1.0
@inlined
def pasted(x):
    return x * 3.0
""",
    "inference/kernel": """
from app.compiling import compiled
from app.inference.helper import called, pasted
from app.inference.numbers import WEIGHT
@compiled
def loop(x, pair):
    return called(x) + 100.0 * pasted(x) + 10000.0 * WEIGHT * x + 1000000.0 * pair.a
""",
    "other": "UNUSED = 1\n",
    "program": """
import json, logging, sys
from app import compiling
from app.inference.helper import called
from app.inference.kernel import loop
from app.inference.tuples import Pair
logging.basicConfig(format="%(message)s", level="INFO")
compiling.check_cache()
with compiling.progress():
    result = loop(1.0, Pair(a=1.0, b=2.0))
compiled = [sum(one.stats.cache_misses.values()) for one in (loop, called)]
print(json.dumps({"result": result, "compiled": compiled, "path": loop.stats.cache_path}))
""",
}
EXPECTED = 1_020_302.0


@pytest.fixture
def package(tmp_path: Path, repository: Path) -> Path:
    """The package `app` in a folder of its own, with the real compiling and little else."""
    folder = tmp_path / "service" / "app"
    folder.mkdir(parents=True)
    (folder / "inference").mkdir()
    for name, text in FILES.items():
        (folder / f"{name}.py").write_text(text)
    (folder / "compiling.py").write_text((repository / "app" / "compiling.py").read_text())
    return folder


def begin(package: Path, **variables: str) -> subprocess.Popen[str]:
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")
    }
    home = package.parent.parent / "home"
    environment |= {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), **variables}
    return subprocess.Popen(
        [sys.executable, "-m", "app.program"],
        cwd=package.parent,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def end(process: subprocess.Popen[str]) -> tuple[Any, str]:
    """The program's answer, and its log."""
    output, log = process.communicate(timeout=120)
    assert process.returncode == 0, log
    return json.loads(output), log


def start(package: Path, **variables: str) -> tuple[Any, str]:
    return end(begin(package, **variables))


def test_a_second_start_compiles_nothing(package: Path) -> None:
    answer, log = start(package)
    assert (answer["result"], answer["compiled"]) == (EXPECTED, [1, 1])
    assert "compiling kernels" in log
    assert "compiling kernel 1 of 2" in log
    (folder,) = (package.parent / ".numba_cache").glob("loops-*")
    assert Path(answer["path"]).is_relative_to(folder)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert folder.parent.stat().st_mode & 0o777 == 0o700
    assert not list(package.rglob("*.nbi"))

    answer, log = start(package)
    assert (answer["result"], answer["compiled"]) == (EXPECTED, [0, 0])
    assert log == ""


@pytest.mark.slow
def test_a_change_of_another_file_is_compiled_in(package: Path) -> None:
    start(package)
    (package / "other.py").write_text("UNUSED = 2\n")
    assert start(package)[0]["compiled"] == [0, 0], "no loop can see it"
    expected = EXPECTED
    for file, old, new, more in (
        ("inference/helper", "x + 1.0", "x + 2.0", 1),
        ("inference/helper", "x * 3.0", "x * 4.0", 100),
        ("inference/numbers", "2.0", "3.0", 10_000),
        ("inference/tuples", "a: float\n    b: float", "b: float\n    a: float", 0),
    ):
        path = package / f"{file}.py"
        path.write_text(path.read_text().replace(old, new))
        expected += more
        answer, _ = start(package)
        assert (answer["result"], answer["compiled"]) == (expected, [1, 1]), (file, new)


@pytest.mark.slow
def test_a_folder_that_others_can_change_is_refused(package: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    start(package, NUMBA_CACHE_DIR=str(root))
    (folder,) = root.glob("loops-*")
    folder.chmod(0o777)
    answer, log = start(package, NUMBA_CACHE_DIR=str(root))
    assert (answer["result"], answer["compiled"], answer["path"]) == (EXPECTED, [1, 1], None)
    assert f"other users can write to {folder}" in log
    folder.chmod(0o700)
    for mode in (0o777, 0o770):
        root.chmod(mode)
        assert "other users can write to" in start(package, NUMBA_CACHE_DIR=str(root))[1]
    root.chmod(0o1777)
    assert "other users" not in start(package, NUMBA_CACHE_DIR=str(root))[1]


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_a_folder_of_another_user_is_refused(package: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    start(package, NUMBA_CACHE_DIR=str(root))
    (folder,) = root.glob("loops-*")
    os.chown(folder, 10001, 10001)
    answer, log = start(package, NUMBA_CACHE_DIR=str(root))
    assert (answer["result"], answer["path"]) == (EXPECTED, None)
    assert f"{folder} or its parent belongs to another user" in log


def test_without_a_folder_beside_the_package_the_users_own_is_used(
    package: Path, tmp_path: Path
) -> None:
    (package.parent / ".numba_cache").write_text("in the way")
    answer, log = start(package)
    assert Path(answer["path"]).is_relative_to(tmp_path / "home" / "cache" / "scene-boltzmann")
    assert "compiled kernels are stored in" in log


def test_only_old_folders_of_ours_are_removed(package: Path, tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    old = [root / f"loops-{number:016x}" for number in range(5)]
    foreign = [root / "app_0123", root / "loops-mine", root / "loops-0123456789abcdefg"]
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept").touch()
    (root / f"loops-{9:016x}").symlink_to(elsewhere)
    for age, folder in enumerate([*old, *foreign]):
        folder.mkdir()
        (folder / "file").touch()
        os.utime(folder, (1000 - age, 1000 - age))
    recent = root / f"loops-{8:016x}"
    recent.mkdir()
    start(package, NUMBA_CACHE_DIR=str(root))
    # The two newest others stay: the recent one, and one of the old.
    assert [folder.exists() for folder in (recent, *old)] == [True, True, *[False] * 4]
    assert all((folder / "file").exists() for folder in foreign)
    assert (elsewhere / "kept").exists()


@pytest.mark.slow
def test_two_that_start_at_once_compile_once(package: Path) -> None:
    both = [begin(package), begin(package)]
    answers, logs = zip(*map(end, both), strict=True)
    assert [answer["result"] for answer in answers] == [EXPECTED, EXPECTED]
    # The second has begun its first loop by the time it waits; it loads all others.
    assert sum(answer["compiled"][1] for answer in answers) == 1, logs
    assert start(package)[0]["compiled"] == [0, 0]


def test_the_digest_holds_every_file_that_is_compiled_in(repository: Path) -> None:
    app = repository / "app"
    found = {str(path.relative_to(app)) for path in compiling.sources(app)}
    assert {
        "compiling.py",
        "inference/elementary.py",
        "inference/relations.py",  # named tuples of weights
        "inference/chains.py",
        "scene/footprints.py",
        "scene/relations.py",  # numbers of relations
        "questions/ranking.py",
    } <= found
    assert not {"main.py", "settings.py", "questions/outliers.py"} & found
    loops = [path for path in app.rglob("*.py") if "njit" in path.read_text()]
    assert loops == [app / "compiling.py"]
