"""Compiled loops: the decorators, the directory in which numba stores the loops, and progress.

A stored loop is code: a user who can write to this directory can run code in the service. So the
service refuses a directory that other users can change.

numba compiles a stored loop again if its own file changes, but not if the file of a constant or of
another loop changes. So the name of the directory has a hash of all files with compiled loops.
These files take constants and loops from each other only.
"""

import hashlib
import logging
import os
import re
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Final, cast

from numba import config, njit
from numba.core import event

_logger = logging.getLogger("app.compiling")

KERNELS: Final[list[Any]] = []
"""Every loop that numba stores on disk."""

_PACKAGE: Final = Path(__file__).parent


def _digest() -> str:
    """Return a hash of this file and of all files of the package with compiled loops."""
    digest = hashlib.sha256(Path(__file__).read_bytes())
    for path in sorted(_PACKAGE.rglob("*.py")):
        source = path.read_bytes()
        if re.search(rb"^@(compiled|inlined)", source, re.MULTILINE):
            digest.update(source)
    return digest.hexdigest()[:16]


_NAME: Final = _digest()


def _folders() -> Iterator[Path]:
    """Yield the directories to try, the preferred one first."""
    if configured := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(configured).absolute()
        return
    yield _PACKAGE.parent / ".numba_cache"
    with suppress(RuntimeError):  # the user does not have a home directory
        cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        yield Path(cache) / "scene-boltzmann"


def _make_private(folder: Path) -> None:
    """Create a directory that only this user can write to. Raise OSError on failure."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status, parent = folder.lstat(), folder.parent.stat()
    if not stat.S_ISDIR(status.st_mode):
        raise NotADirectoryError(f"{folder} is not a directory")
    if status.st_uid != os.geteuid() or parent.st_uid not in {os.geteuid(), 0}:
        raise PermissionError(f"{folder} or its parent belongs to another user")
    # In a parent with the sticky bit, such as /tmp, others cannot replace files of this user.
    by_others = stat.S_IWGRP | stat.S_IWOTH
    unsafe_parent = parent.st_mode & by_others and not parent.st_mode & stat.S_ISVTX
    if status.st_mode & by_others or unsafe_parent:
        raise PermissionError(f"other users can write to {folder} or to its parent")
    tempfile.TemporaryFile(dir=folder).close()


def _choose() -> tuple[Path | None, str]:
    """Return the first usable directory or None, and why the directories before it are not."""
    problems: list[str] = []
    for folder in _folders():
        try:
            # A child process inherits the variable, with the hash.
            if folder.name != _NAME:
                _make_private(folder)
                folder /= _NAME
            _make_private(folder)
            return folder, "; ".join(problems)
        except OSError as error:
            problems.append(str(error))
    return None, "; ".join(problems)


FOLDER, _PROBLEM = _choose()
"""The directory of compiled loops, or None if no directory is usable."""
if FOLDER is not None:
    os.environ["NUMBA_CACHE_DIR"] = str(FOLDER)  # for child processes
    config.CACHE_DIR = str(FOLDER)  # type: ignore[attr-defined]


def _kernel(function: Callable[..., Any], **options: Any) -> Any:
    """Return a function compiled by numba, and list it in `KERNELS`."""
    options |= {"cache": FOLDER is not None, "nogil": True, "error_model": "numpy"}
    # Only Python calls the loops, so they need no wrapper for C.
    options["no_cfunc_wrapper"] = True
    kernel = njit(**options)(function)
    KERNELS.append(kernel)
    return kernel


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function. In compiled code, division by zero gives infinity or NaN."""
    return _kernel(function)


def compiled_in_any_order(function: Callable[..., Any]) -> Any:
    """Compile a function, and let the compiler reorder sums to use vector instructions.

    The compiler chooses the order of the terms once, so results are reproducible.
    """
    return _kernel(function, fastmath={"reassoc", "contract"})


def inlined(function: Callable[..., Any]) -> Any:
    """Inline a function into each compiled function that calls it. Its sums keep their order."""
    return njit(forceinline=True, error_model="numpy")(function)


def check_cache() -> None:
    """Log a warning without a cache directory, and an info if it is not the preferred directory."""
    if FOLDER is None:
        _logger.warning(
            "each start compiles the loops, because no cache directory is usable: %s; set "
            "NUMBA_CACHE_DIR to a folder that only this user can write to",
            _PROBLEM,
        )
    elif _PROBLEM:
        _logger.info("compiled loops are stored in %s: %s", FOLDER, _PROBLEM)


def progress() -> AbstractContextManager[Any]:
    """Return a context manager that logs the loops compiled in its ``with`` block."""
    listener = event.install_listener("numba:compile", _Progress())
    return cast("AbstractContextManager[Any]", listener)


class _Progress(event.Listener):
    """Event listener that logs at most one line per second."""

    def __init__(self) -> None:
        self._kernels = {id(kernel) for kernel in KERNELS}
        self._begun: set[int] = set()
        self._logged = float("-inf")

    def on_start(self, event: Any) -> None:
        """Log the start of a loop's compilation. Ignore functions of numba itself."""
        kernel = id(event.data["dispatcher"])
        if kernel not in self._kernels:
            return
        if not self._begun:
            _logger.info("compiling loops, once for this version")
        self._begun.add(kernel)
        if time.monotonic() - self._logged >= 1:
            _logger.info("compiling loop %d of %d", len(self._begun), len(self._kernels))
            self._logged = time.monotonic()

    def on_end(self, event: Any) -> None:
        """Ignore the end of a compilation."""
