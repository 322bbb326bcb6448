"""Reading regular files, and writing files so that a crash leaves the old state or the new state.

A rename is atomic for readers. To survive a power failure, fsync writes the bytes of a file to disk
before the rename, and the directory entry after it. A lock lets only one process at a time write.
"""

import errno
import fcntl
import os
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from app.registry.errors import StoreError


def read_file(path: Path, limit: int) -> bytes:
    """Read at most limit + 1 bytes of a regular file. The extra byte shows that it is too long.

    Raises:
        OSError: the file cannot be read, or is a link, a FIFO or another special file.
    """

    def opener(name: str, flags: int) -> int:
        # Without O_NONBLOCK, opening a FIFO would block. A link could lead out of the store.
        return os.open(name, flags | os.O_NONBLOCK | os.O_NOFOLLOW)

    with open(str(path), "rb", opener=opener) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file")
        # read() first allocates a buffer for all requested bytes.
        return file.read(min(status.st_size, limit) + 1)


def write_file(path: Path, data: bytes) -> None:
    """Create a new file and sync its bytes to disk. An existing path raises FileExistsError."""
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_directory(path: Path) -> None:
    """Sync the entries of a directory to disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_directory(path: Path) -> None:
    """Create a missing directory and its parents, and sync the new directory entries to disk."""
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
    """Create a file, or replace its contents atomically. The prefix names the temporary file."""
    temporary = path.with_name(f"{prefix}{path.name}")
    try:
        write_file(temporary, data)
        rename(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def exclusive(path: Path, timeout: float) -> Iterator[None]:
    """Hold an exclusive lock on a file. The kernel releases the lock when the process ends.

    Raises:
        StoreError: `locked`, if another process still holds the lock after ``timeout`` seconds.
    """
    deadline = time.monotonic() + timeout
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    holder = "another process still holds the lock of the store"
                    reason = f"{holder} after {timeout:g} s; try again later"
                    raise StoreError("locked", reason) from None
                time.sleep(0.01)
        yield
    finally:
        os.close(descriptor)
