"""A lock between processes, so that only one process at a time writes to a store."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from app.registry.errors import StoreError


@contextmanager
def exclusive(path: Path, timeout: float) -> Iterator[None]:
    """Hold an exclusive lock on a file.

    The kernel releases the lock when the process ends, even after a crash.

    Args:
        path: the lock file. The function creates it if it is missing, and never removes it.
        timeout: time in seconds to wait for another process that holds the lock.

    Raises:
        StoreError: `locked`, if another process still holds the lock after ``timeout``.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
    try:
        _wait(descriptor, timeout)
        yield
    finally:
        os.close(descriptor)


def _wait(descriptor: int, timeout: float) -> None:
    deadline = time.monotonic() + timeout
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= deadline:
                waited = (
                    f"another process still holds the lock of the store after {timeout:g} s; try "
                    "again later"
                )
                raise StoreError("locked", waited) from None
            time.sleep(0.01)
        else:
            return
