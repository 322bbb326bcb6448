"""How loops are compiled: by numba, kept on disk between processes, without the interpreter's lock.

Compiled code must never be older than its sources. numba checks the file of a loop before it uses
the loop's code, but functions and constants of other files are compiled in too. So the code lies in
a directory named by a digest: of all files that can be compiled in, of the versions of Python,
numba, llvmlite and numpy, and of the CPU. `python -m app.compile` fills it ahead of the first
start.

The directory holds pickled code: a user who writes to it runs code in the service. It is made for
the service's own user alone, and one that other users can change is refused.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import platform
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from fnmatch import fnmatch
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, TypeAlias

Function: TypeAlias = Callable[..., Any]

_logger = logging.getLogger("app.compiling")

_PACKAGE: Final = Path(__file__).parent

_NAMES: Final = "loops-" + 16 * "[0-9a-f]"

# All files of these packages belong to the digest.
_KERNELS: Final = ("inference", "scene")

# Directories of other versions that stay, so that going back to one compiles nothing.
_KEPT: Final = 2
# Seconds after its last start for which a directory stays in any case.
_RECENT: Final = 600.0
# Seconds to wait for another process that compiles, at most; then both do, which is safe.
_PATIENCE: Final = 600.0


def sources(package: Path) -> list[Path]:
    """The files that can be compiled in: two packages, and every module that declares a loop."""
    paths = sorted(package.rglob("*.py"))
    return [
        path
        for path in paths
        if path.relative_to(package).parts[0] in _KERNELS or b"app.compiling" in path.read_bytes()
    ]


def digest(package: Path) -> str:
    """Sixteen hexadecimal digits for the sources of loops, the compiler and the CPU."""
    versions = [version(name) for name in ("numba", "llvmlite", "numpy")]
    found = hashlib.sha256(repr((sys.version, versions, platform.machine(), _cpu())).encode())
    for path in [*sources(package), Path(__file__)]:
        text = path.read_bytes()
        found.update(f"{path.name} {len(text)} ".encode())
        found.update(text)
    return found.hexdigest()[:16]


def _cpu() -> str:
    """The processor's model and features, where the system tells."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        return "".join(line for line in lines if line.startswith(("model name", "flags", "Feat")))
    return platform.processor()


def _prepare(root: str) -> tuple[Path | None, str]:
    """The directory of compiled code, and why a better place was not used; None without any.

    Args:
        root: holds the directories; "" for `.numba_cache` beside the package or, where that cannot
            be used, in the user's cache directory.
    """
    name, problems = f"loops-{digest(_PACKAGE)}", []
    roots = [Path(root)] if root else [_PACKAGE.parent / ".numba_cache", *_user_cache()]
    if fnmatch(roots[0].name, _NAMES):  # the process that started this one has chosen it
        roots = [roots[0].parent]
    for candidate in roots:
        folder = candidate.absolute() / name
        try:
            _make_private(folder)
        except OSError as error:
            problems.append(str(error))
        else:
            _remove_old(folder)
            return folder, "; ".join(problems)
    return None, "; ".join(problems)


def _user_cache() -> list[Path]:
    if given := os.environ.get("XDG_CACHE_HOME"):
        return [Path(given) / "scene-boltzmann"]
    with suppress(RuntimeError):  # the user has no home
        return [Path.home() / ".cache" / "scene-boltzmann"]
    return []


def _make_private(folder: Path) -> None:
    """Create a directory, or refuse one that this process cannot, or other users can, write to."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    own, root = folder.lstat(), folder.parent.stat()
    if not stat.S_ISDIR(own.st_mode):
        raise NotADirectoryError(f"{folder} is a link")
    if own.st_uid != os.geteuid() or root.st_uid not in {os.geteuid(), 0}:
        raise PermissionError(f"{folder} or its parent belongs to another user")
    # Others may add files to a sticky directory such as /tmp; they cannot replace ours.
    is_open = root.st_mode & stat.S_IWOTH and not root.st_mode & stat.S_ISVTX
    if is_open or own.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"other users can write to {folder}")
    tempfile.TemporaryFile(dir=folder).close()
    os.utime(folder)


def _remove_old(current: Path) -> None:
    others = []
    for folder in current.parent.glob(_NAMES):
        with suppress(FileNotFoundError):  # another process removes it
            status = folder.lstat()
            is_ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid()
            if is_ours and folder != current:
                others.append((status.st_mtime, folder))
    others.sort(reverse=True)
    for used, folder in others[_KEPT:]:
        if time.time() - used > _RECENT:
            shutil.rmtree(folder, ignore_errors=True)


_FOLDER, _PROBLEM = _prepare(os.environ.get("NUMBA_CACHE_DIR", ""))
if _FOLDER is not None:
    # For processes that this one starts.
    os.environ["NUMBA_CACHE_DIR"] = str(_FOLDER)

from numba import config, njit  # noqa: E402
from numba.core import event  # noqa: E402

if _FOLDER is not None:
    # numba may have been imported before, and has then read another value.
    config.CACHE_DIR = str(_FOLDER)  # type: ignore[attr-defined]

_LOOPS: Final[list[Any]] = []


def _compile(function: Function, **options: Any) -> Function:
    options |= {"cache": _FOLDER is not None, "nogil": True, "error_model": "numpy"}
    # No caller is written in C.
    options["no_cfunc_wrapper"] = True
    found: Function = njit(**options)(function)
    _LOOPS.append(found)
    return found


def compiled(function: Function) -> Function:
    """Compile a function; division by zero gives what the hardware gives."""
    return _compile(function)


def compiled_in_any_order(function: Function) -> Function:
    """The same, with sums in any order, so that the compiler can take eight terms at a time.

    It chooses one order, once. `elementary` must stay out of such functions: the cancellations of
    exp and log are meant.
    """
    return _compile(function, fastmath={"reassoc", "contract"})


def inlined(function: Function) -> Function:
    """Part of whichever compiled function calls it, and compiled as that one is."""
    found: Function = njit(inline="always", error_model="numpy")(function)
    return found


def check_cache() -> None:
    """Log where loops are kept, unless that is the usual place."""
    if _FOLDER is None:
        _logger.warning("compiled loops are not kept, each start compiles them: %s", _PROBLEM)
    elif _PROBLEM:
        _logger.info("compiled loops are kept in %s: %s", _FOLDER, _PROBLEM)


@contextmanager
def progress() -> Iterator[None]:
    """Log that loops are compiled, if they are; one process at a time compiles."""
    if _FOLDER is None or (_FOLDER / "complete").exists():
        yield
        return
    descriptor = os.open(_FOLDER / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        _wait(descriptor)
        if not (_FOLDER / "complete").exists():
            _logger.info("compiling loops, once for these sources: this takes a minute")
        with event.install_listener("numba:compile", _Progress()):
            yield
        (_FOLDER / "complete").touch()
    finally:
        os.close(descriptor)


class _Progress(event.Listener):
    """Logs a line a second while loops are compiled."""

    def __init__(self) -> None:
        self._begun: set[int] = set()
        self._logged = float("-inf")

    def on_start(self, event: Any) -> None:
        """A function is about to be compiled; numba compiles some of its own."""
        loop = event.data["dispatcher"]
        if not any(loop is known for known in _LOOPS):
            return
        self._begun.add(id(loop))
        if time.monotonic() - self._logged >= 1:
            done = sum(bool(one.signatures) or id(one) in self._begun for one in _LOOPS)
            _logger.info("compiling loop %d of %d", done, len(_LOOPS))
            self._logged = time.monotonic()

    def on_end(self, event: Any) -> None:
        """The function is compiled."""


def _wait(descriptor: int) -> None:
    deadline, is_waiting = time.monotonic() + _PATIENCE, False
    while time.monotonic() < deadline:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not is_waiting:
                _logger.info("waiting for another process, which compiles the same loops")
                is_waiting = True
            time.sleep(0.1)
        except OSError:  # a file system without locks
            return
        else:
            return
