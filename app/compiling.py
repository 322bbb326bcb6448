"""Compilation of kernels with numba: cached on disk, and run without the interpreter's lock.

Compiled code must match its sources. numba checks the file of a kernel before it uses the kernel's
code. But this code also contains functions and constants of other files. So the name of the cache
directory is a digest of all these files, of the versions of Python, numba, llvmlite and numpy, and
of the CPU. `python -m app.compile` fills the directory before the first start.

The directory contains pickled code: a user who can write to it can run code in the service. So only
the user of the service may access it. The service refuses a directory that other users can change.
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

# The digest covers all files of these packages.
_KERNELS: Final = ("inference", "scene")

# Number of directories of other versions that are kept, so that a downgrade need not compile.
_KEPT: Final = 2
# Seconds after its last use during which a directory is always kept.
_RECENT: Final = 600.0
# Maximum seconds to wait for another process that compiles; then both compile, which is safe.
_PATIENCE: Final = 600.0


def sources(package: Path) -> list[Path]:
    """Return the files whose code may be compiled: two packages, and modules with kernels."""
    paths = sorted(package.rglob("*.py"))
    return [
        path
        for path in paths
        if path.relative_to(package).parts[0] in _KERNELS or b"app.compiling" in path.read_bytes()
    ]


def digest(package: Path) -> str:
    """Return 16 hexadecimal digits for the kernel sources, the compiler and the CPU."""
    versions = [version(name) for name in ("numba", "llvmlite", "numpy")]
    found = hashlib.sha256(repr((sys.version, versions, platform.machine(), _cpu())).encode())
    for path in [*sources(package), Path(__file__)]:
        text = path.read_bytes()
        found.update(f"{path.name} {len(text)} ".encode())
        found.update(text)
    return found.hexdigest()[:16]


def _cpu() -> str:
    """Return the model and features of the processor, as far as the system reports them."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        return "".join(line for line in lines if line.startswith(("model name", "flags", "Feat")))
    return platform.processor()


def _prepare(root: str) -> tuple[Path | None, str]:
    """Create the directory of compiled code.

    Args:
        root: parent of the directories; "" for `.numba_cache` beside the package or, if that is not
            usable, the user's cache directory.

    Returns:
        The directory, or None if none is usable; and the reasons against the unusable ones.
    """
    name, problems = f"loops-{digest(_PACKAGE)}", []
    roots = [Path(root)] if root else [_PACKAGE.parent / ".numba_cache", *_user_cache()]
    if fnmatch(roots[0].name, _NAMES):  # chosen by the parent process
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
    with suppress(RuntimeError):  # the user does not have a home directory
        return [Path.home() / ".cache" / "scene-boltzmann"]
    return []


def _make_private(folder: Path) -> None:
    """Create a directory that only this user can write to; raise OSError if that fails."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    own, root = folder.lstat(), folder.parent.stat()
    if not stat.S_ISDIR(own.st_mode):
        raise NotADirectoryError(f"{folder} is not a directory")
    if own.st_uid != os.geteuid() or root.st_uid not in {os.geteuid(), 0}:
        raise PermissionError(f"{folder} or its parent belongs to another user")
    # In a sticky directory such as /tmp, other users can add files but not replace our files.
    is_open = root.st_mode & stat.S_IWOTH and not root.st_mode & stat.S_ISVTX
    if is_open or own.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"other users can write to {folder}")
    tempfile.TemporaryFile(dir=folder).close()
    os.utime(folder)


def _remove_old(current: Path) -> None:
    others = []
    for folder in current.parent.glob(_NAMES):
        with suppress(FileNotFoundError):  # another process has removed it
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
    # For child processes.
    os.environ["NUMBA_CACHE_DIR"] = str(_FOLDER)

from numba import config, njit  # noqa: E402
from numba.core import event  # noqa: E402

if _FOLDER is not None:
    # numba may have been imported earlier with another value.
    config.CACHE_DIR = str(_FOLDER)  # type: ignore[attr-defined]

_LOOPS: Final[list[Any]] = []


def _compile(function: Function, **options: Any) -> Function:
    options |= {"cache": _FOLDER is not None, "nogil": True, "error_model": "numpy"}
    # Kernels are never called from C.
    options["no_cfunc_wrapper"] = True
    found: Function = njit(**options)(function)
    _LOOPS.append(found)
    return found


def compiled(function: Function) -> Function:
    """Compile a function; division by zero gives the hardware's result (infinity or NaN)."""
    return _compile(function)


def compiled_in_any_order(function: Function) -> Function:
    """Compile a function whose sums the compiler may reorder, for vector instructions.

    The compiler chooses the order once, so results are reproducible. Such functions must not call
    `elementary`, where the order of operations in exp and log matters.
    """
    return _compile(function, fastmath={"reassoc", "contract"})


def inlined(function: Function) -> Function:
    """Inline a function into the compiled functions that call it, with their options."""
    found: Function = njit(inline="always", error_model="numpy")(function)
    return found


def check_cache() -> None:
    """Log the directory of compiled kernels, unless it is the usual directory."""
    if _FOLDER is None:
        _logger.warning("no directory for compiled kernels, each start compiles: %s", _PROBLEM)
    elif _PROBLEM:
        _logger.info("compiled kernels are stored in %s: %s", _FOLDER, _PROBLEM)


@contextmanager
def progress() -> Iterator[None]:
    """Log the compilation of kernels in the context; only one process compiles at a time."""
    if _FOLDER is None or (_FOLDER / "complete").exists():
        yield
        return
    descriptor = os.open(_FOLDER / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        _wait(descriptor)
        if not (_FOLDER / "complete").exists():
            _logger.info("compiling kernels (about a minute, once for this version)")
        with event.install_listener("numba:compile", _Progress()):
            yield
        (_FOLDER / "complete").touch()
    finally:
        os.close(descriptor)


class _Progress(event.Listener):
    """Log at most one line per second while kernels are compiled."""

    def __init__(self) -> None:
        self._begun: set[int] = set()
        self._logged = float("-inf")

    def on_start(self, event: Any) -> None:
        """Log the start of a compilation; ignore functions of numba itself."""
        loop = event.data["dispatcher"]
        if not any(loop is known for known in _LOOPS):
            return
        self._begun.add(id(loop))
        if time.monotonic() - self._logged >= 1:
            done = sum(bool(one.signatures) or id(one) in self._begun for one in _LOOPS)
            _logger.info("compiling kernel %d of %d", done, len(_LOOPS))
            self._logged = time.monotonic()

    def on_end(self, event: Any) -> None:
        """Ignore the end of a compilation."""


def _wait(descriptor: int) -> None:
    deadline, is_waiting = time.monotonic() + _PATIENCE, False
    while time.monotonic() < deadline:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if not is_waiting:
                _logger.info("waiting for another process that compiles the same kernels")
                is_waiting = True
            time.sleep(0.1)
        except OSError:  # a file system without locks
            return
        else:
            return
