"""Where compiled loops are kept between processes: a folder for each state of the sources.

numba checks the file of a loop before it uses the loop's compiled code. Functions, constants and
named tuples of other files are compiled into the loop too, and numba does not check those files.
The name of the folder is therefore a digest of all these files, of the compiler and of the CPU.

The folder holds pickled code: a user who writes to it runs code in the service. The service
creates it for its own user alone, and refuses one that other users can change.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import llvmlite
import numba
import numpy as np
from llvmlite import binding

_logger = logging.getLogger("app.compiling")

_FOLDER: Final = re.compile(r"loops-[0-9a-f]{16}")

# Folders of other versions that stay, so that going back to one compiles nothing.
_KEPT = 2
# Seconds after its last start for which a folder stays in any case: its process may still compile.
_RECENT = 600.0
# Seconds to wait for another process that compiles, at most.
_PATIENCE = 600.0

_IMPORT: Final = re.compile(rb"^[ \t]*from ([\w.]+) import (\([^)]*\)|[^\n#]*)", re.MULTILINE)
_NAMED_TUPLE: Final = re.compile(rb"^class \w+\(NamedTuple", re.MULTILINE)
_DECORATORS: Final = {b"compiled", b"compiled_in_any_order", b"inlined"}
_CONSTANT: Final = re.compile(r"_?[A-Z][A-Z0-9_]*")


def prepare(root: str) -> tuple[Path | None, str]:
    """The folder of this package's compiled loops; folders of old versions are removed.

    Args:
        root: holds the folders; "" for `.numba_cache` beside the package or, where that cannot be
            used, in the user's cache directory.

    Returns:
        The folder, None where loops cannot be kept, and why a better place was not used, or "".
    """
    package = Path(__file__).parent
    name = f"loops-{digest(package)}"
    roots = [Path(root)] if root else [package.parent / ".numba_cache", *_user_cache()]
    problems = []
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
    """Create a folder, or refuse one that the process cannot, or other users can, write to."""
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    folder.mkdir(mode=0o700, exist_ok=True)
    own, root = folder.lstat(), folder.parent.stat()
    if not stat.S_ISDIR(own.st_mode):
        raise NotADirectoryError(f"{folder} is a link")
    if own.st_uid != os.geteuid() or root.st_uid not in {os.geteuid(), 0}:
        raise PermissionError(f"{folder} belongs to another user")
    # Others may add files to a sticky folder such as /tmp; they cannot replace ours.
    is_open = root.st_mode & stat.S_IWOTH and not root.st_mode & stat.S_ISVTX
    if is_open or own.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise PermissionError(f"other users can write to {folder}")
    tempfile.TemporaryFile(dir=folder).close()
    os.utime(folder)


def _remove_old(current: Path) -> None:
    others = []
    for folder in current.parent.iterdir():
        with suppress(FileNotFoundError):  # another process removes it
            status = folder.lstat()
            is_ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid()
            if is_ours and folder != current and _FOLDER.fullmatch(folder.name):
                others.append((status.st_mtime, folder))
    others.sort(reverse=True)
    for used, folder in others[_KEPT:]:
        if time.time() - used > _RECENT:
            shutil.rmtree(folder, ignore_errors=True)


def digest(package: Path) -> str:
    """Sixteen hexadecimal digits for the sources of loops, the compiler and the CPU."""
    versions = (numba.__version__, llvmlite.__version__, np.__version__)
    found = hashlib.sha256(repr((sys.implementation.cache_tag, versions, _target())).encode())
    for name, text in sources(package).items():
        found.update(f"{name} {len(text)} ".encode())
        found.update(text)
    return found.hexdigest()[:16]


def _target() -> tuple[str, str, str]:
    config: Any = numba.config
    name = config.CPU_NAME or binding.get_host_cpu_name()
    features = config.CPU_FEATURES
    if features is None:
        try:
            features = binding.get_host_cpu_features().flatten()
        except RuntimeError:  # LLVM does not know them on every system
            features = ""
    return binding.get_process_triple(), name, features


def sources(package: Path) -> dict[str, bytes]:
    """The files whose contents are compiled into loops, by module, in alphabetical order.

    These are the files that declare loops, those that declare named tuples, and those whose
    constants (names in capitals) such a file imports.
    """
    texts = {
        ".".join((package.name, *path.relative_to(package).with_suffix("").parts)): path
        for path in package.rglob("*.py")
    }
    modules = {name.removesuffix(".__init__"): path.read_bytes() for name, path in texts.items()}
    compiler = f"{package.name}.compiling"
    pending = [name for name, text in modules.items() if _is_compiled(text, compiler)]
    found = {*pending, compiler} & modules.keys()
    while pending:
        new = _imported(modules[pending.pop()]) & modules.keys() - found
        found |= new
        pending += new
    return {name: modules[name] for name in sorted(found)}


def _is_compiled(text: bytes, compiler: str) -> bool:
    if _NAMED_TUPLE.search(text):
        return True
    name = compiler.encode()
    return name in text and any(
        module == name and _DECORATORS & set(re.findall(rb"\w+", names))
        for module, names in _IMPORT.findall(text)
    )


def _imported(text: bytes) -> set[str]:
    """Modules that a file imports as a whole, or constants of which it imports."""
    found = set()
    for module, names in _IMPORT.findall(text):
        for name in re.findall(r"\w+", names.decode()):
            found.add(f"{module.decode()}.{name}")
            if _CONSTANT.fullmatch(name):
                found.add(module.decode())
    return found


@contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, so that one process compiles and others then load its work.

    A process that waits too long goes on: it compiles the same again, which is safe.
    """
    descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        _wait(descriptor)
        yield
    finally:
        os.close(descriptor)


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
