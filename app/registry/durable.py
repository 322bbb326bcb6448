"""Writing files so that a crash leaves either the old state or the new one.

A rename is atomic for readers at once, but survives a power cut only when the file's bytes were on
disk before it and the directory's entry is on disk after it. Each fsync here serves this.
"""

from __future__ import annotations

import os
import secrets
from pathlib import Path


def write_file(path: Path, data: bytes) -> None:
    """Create a file that must not exist yet, and bring its bytes to disk."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    with os.fdopen(descriptor, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_directory(path: Path) -> None:
    """Bring a directory's entries to disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_directory(path: Path) -> None:
    """Create a directory (and missing parents) whose entry survives a crash; existing is fine."""
    if path.is_dir():
        return
    make_directory(path.parent)
    path.mkdir(mode=0o755, exist_ok=True)
    sync_directory(path.parent)


def rename(source: Path, target: Path) -> None:
    """Move within one directory, and bring the move to disk."""
    source.rename(target)
    sync_directory(target.parent)


def replace_file(path: Path, data: bytes, *, prefix: str) -> None:
    """Give a file new contents in one step; `prefix` marks the temporary sibling."""
    temporary = path.with_name(f"{prefix}{secrets.token_hex(8)}")
    try:
        write_file(temporary, data)
        rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
