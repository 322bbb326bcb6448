"""Writing files so that a crash leaves either the old state or the new state.

A rename is atomic for readers. To survive a power failure, the file's bytes must be on disk before
the rename, and the directory entry after it. The calls of fsync ensure both.
"""

from __future__ import annotations

import os
import secrets
from pathlib import Path


def write_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Create a new file and sync its bytes to disk. Raise FileExistsError if it exists."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_directory(path: Path) -> None:
    """Sync the entries of a directory to disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_directory(path: Path) -> None:
    """Create a directory and its missing parents, and sync them to disk.

    An existing directory is left unchanged.
    """
    if path.is_dir():
        return
    make_directory(path.parent)
    path.mkdir(mode=0o755, exist_ok=True)
    sync_directory(path.parent)


def rename(source: Path, target: Path) -> None:
    """Rename a file within its directory, and sync the directory to disk."""
    source.rename(target)
    sync_directory(target.parent)


def replace_file(path: Path, data: bytes, *, prefix: str) -> None:
    """Replace the contents of a file atomically.

    The new contents are first in a temporary file in the same directory. Its name starts with
    `prefix`.
    """
    temporary = path.with_name(f"{prefix}{secrets.token_hex(8)}")
    try:
        write_file(temporary, data)
        rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
