"""Lines of files that others wrote, within bounds."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path

from training.datasets.records import DatasetError


def read_lines(path: Path, limit: int) -> Iterator[bytes]:
    """The lines of a file, gzipped where its name says so, undecoded.

    A line that is not UTF-8 is then one bad line. The limit keeps a small compressed file from
    filling the memory.

    Args:
        path: the file.
        limit: bytes of a line, its end included.

    Raises:
        DatasetError: the file cannot be read, or has a longer line.
    """
    opener = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rb") as file:
            number = 0
            while line := file.readline(limit + 1):
                number += 1
                if len(line) > limit:
                    raise DatasetError(path, f"line {number}", f"is longer than {limit} bytes")
                yield line
    except (OSError, EOFError, zlib.error) as error:
        raise DatasetError(path, "", f"cannot be read: {error}") from error
