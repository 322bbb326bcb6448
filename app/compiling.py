"""Compilation of kernels (numeric functions) with numba. Compiled kernels are cached on disk.

A cached kernel must match its sources. numba checks only the file that defines the kernel. But the
compiled code also contains functions and constants of other source files. So the name of the cache
directory contains a digest of all kernel sources, of the versions of Python, numba, llvmlite and
numpy, and of the CPU. `python -m app.compile` fills the cache directory before the first start.

The cache directory contains pickled code: a user who can write to this directory can run code in
the service. So the service refuses a cache directory that other users can change.
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
# The digest in the name of the cache directory covers all files of these packages of `app`.
_PACKAGES: Final = ("inference", "scene")

# Number of cache directories of other versions to keep. After a downgrade, the service can then use
# the compiled kernels of the older version.
_KEPT: Final = 2
# The service keeps each cache directory for at least this time in seconds after its last use.
_RECENT: Final = 600.0


def sources(package: Path) -> list[Path]:
    """Return the files whose code a kernel may contain.

    The list contains all files of the packages in `_PACKAGES`, and all modules that import
    `app.compiling`.
    """
    paths = sorted(package.rglob("*.py"))
    return [
        path
        for path in paths
        if path.relative_to(package).parts[0] in _PACKAGES or b"app.compiling" in path.read_bytes()
    ]


def digest(package: Path) -> str:
    """Return a digest of the kernel sources, the compiler and the CPU: 16 hexadecimal digits."""
    versions = [version(name) for name in ("numba", "llvmlite", "numpy")]
    sha256 = hashlib.sha256(repr((sys.version, versions, platform.machine(), _cpu())).encode())
    for path in [*sources(package), Path(__file__)]:
        text = path.read_bytes()
        sha256.update(f"{path.name} {len(text)} ".encode())
        sha256.update(text)
    return sha256.hexdigest()[:16]


def _cpu() -> str:
    """Return the CPU's model name and feature flags, if the operating system reports them."""
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().split("\n\n")[0].splitlines()
        return "".join(line for line in lines if line.startswith(("model name", "flags", "Feat")))
    return platform.processor()


def _prepare(root: str) -> tuple[Path | None, str]:
    """Create the cache directory of compiled kernels in the directory ``root``.

    With root "", the function tries `.numba_cache` beside the package `app`, then the user's cache
    directory.

    Returns:
        The cache directory, or None if no directory is usable. Then a text with the reason for each
        unusable directory.
    """
    name, problems = f"loops-{digest(_PACKAGE)}", []
    roots = [Path(root)] if root else [_PACKAGE.parent / ".numba_cache", *_user_cache()]
    if fnmatch(roots[0].name, _NAMES):  # the parent process has set `root`
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
    if cache := os.environ.get("XDG_CACHE_HOME"):
        return [Path(cache) / "scene-boltzmann"]
    with suppress(RuntimeError):  # the user does not have a home directory
        return [Path.home() / ".cache" / "scene-boltzmann"]
    return []


def _make_private(folder: Path) -> None:
    """Create a directory that only this user can write to. Raise OSError on failure."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    status, parent = folder.lstat(), folder.parent.stat()
    if not stat.S_ISDIR(status.st_mode):
        raise NotADirectoryError(f"{folder} is not a directory")
    if status.st_uid != os.geteuid() or parent.st_uid not in {os.geteuid(), 0}:
        raise PermissionError(f"{folder} or its parent belongs to another user")
    # A parent with the sticky bit, such as /tmp, is safe. Other users can add files to this parent,
    # but they cannot replace files of this user.
    by_others = stat.S_IWGRP | stat.S_IWOTH
    unsafe_parent = parent.st_mode & by_others and not parent.st_mode & stat.S_ISVTX
    if status.st_mode & by_others or unsafe_parent:
        raise PermissionError(f"other users can write to {folder} or to its parent")
    tempfile.TemporaryFile(dir=folder).close()
    os.utime(folder)


def _remove_old(current: Path) -> None:
    """Remove cache directories of other versions, except the `_KEPT` newest and recent ones."""
    folders = []
    for folder in current.parent.glob(_NAMES):
        with suppress(FileNotFoundError):  # another process has removed the directory
            status = folder.lstat()
            is_ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid()
            if is_ours and folder != current:
                folders.append((status.st_mtime, folder))
    folders.sort(reverse=True)
    for last_use, folder in folders[_KEPT:]:
        if time.time() - last_use > _RECENT:
            shutil.rmtree(folder, ignore_errors=True)


_FOLDER, _PROBLEM = _prepare(os.environ.get("NUMBA_CACHE_DIR", ""))
if _FOLDER is not None:
    # Child processes read this variable and use the same cache directory.
    os.environ["NUMBA_CACHE_DIR"] = str(_FOLDER)

from numba import config, njit  # noqa: E402
from numba.core import event  # noqa: E402

if _FOLDER is not None:
    # numba reads the variable NUMBA_CACHE_DIR only at its import. Another module may have imported
    # numba earlier.
    config.CACHE_DIR = str(_FOLDER)  # type: ignore[attr-defined]

_KERNELS: Final[list[Any]] = []


def _compile(function: Function, **options: Any) -> Function:
    options |= {"cache": _FOLDER is not None, "nogil": True, "error_model": "numpy"}
    # Only Python calls the kernels, so they need no wrapper for C.
    options["no_cfunc_wrapper"] = True
    kernel: Function = njit(**options)(function)
    _KERNELS.append(kernel)
    return kernel


def compiled(function: Function) -> Function:
    """Compile a function. In compiled code, division by zero gives infinity or NaN."""
    return _compile(function)


def compiled_in_any_order(function: Function) -> Function:
    """Compile a function, and let the compiler reorder sums to use vector instructions.

    The compiler chooses the order of the terms once, so results are reproducible. The function must
    not call the module `elementary`, because its exp and log depend on the order of operations.
    """
    return _compile(function, fastmath={"reassoc", "contract"})


def inlined(function: Function) -> Function:
    """Inline a function into each compiled function that calls it.

    The compiler options of the calling function then apply to the inlined code.
    """
    kernel: Function = njit(inline="always", error_model="numpy")(function)
    return kernel


def check_cache() -> None:
    """Log a warning without a cache directory, and an info if it is not the preferred directory."""
    if _FOLDER is None:
        _logger.warning(
            "each start compiles the kernels, because no cache directory is usable: %s", _PROBLEM
        )
    elif _PROBLEM:
        _logger.info("compiled kernels are stored in %s: %s", _FOLDER, _PROBLEM)


@contextmanager
def progress() -> Iterator[None]:
    """Log each kernel that the ``with`` block compiles. Only one process compiles at a time."""
    if _FOLDER is None or (_FOLDER / "complete").exists():
        yield
        return
    descriptor = os.open(_FOLDER / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        _lock(descriptor)
        if not (_FOLDER / "complete").exists():
            _logger.info("compiling kernels, which takes about a minute, once for this version")
        with event.install_listener("numba:compile", _Progress()):
            yield
        (_FOLDER / "complete").touch()
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock a file. The kernel releases the lock when the process that holds the lock ends."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        _logger.info("waiting until another process has compiled the same kernels")
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError:  # the file system does not support file locks
        return


class _Progress(event.Listener):
    """Event listener that logs at most one line per second while numba compiles kernels."""

    def __init__(self) -> None:
        self._begun: set[int] = set()
        self._logged = float("-inf")

    def on_start(self, event: Any) -> None:
        """Log the start of a kernel's compilation. Ignore functions of numba itself."""
        compiling = event.data["dispatcher"]
        if not any(kernel is compiling for kernel in _KERNELS):
            return
        self._begun.add(id(compiling))
        if time.monotonic() - self._logged >= 1:
            done = sum(bool(k.signatures) or id(k) in self._begun for k in _KERNELS)
            _logger.info("compiling kernel %d of %d", done, len(_KERNELS))
            self._logged = time.monotonic()

    def on_end(self, event: Any) -> None:
        """Ignore the end of a compilation."""
