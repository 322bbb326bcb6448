"""Read data files with size limits. Each error names the file, and its position or the limit."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from training.datasets.records import DatasetError

MAX_BYTES: Final = 2**30
"""Maximum size of a text file in bytes, after decompression."""
MAX_DIGITS: Final = 30
DATA: Final = Path("../shared/data")
"""Default folder of the shipped data sources."""


def read_lines(path: Path, limit: int) -> Iterator[bytes]:
    """Yield the lines of a file as bytes. A file named ``*.gz`` is decompressed.

    The lines are not decoded, so that invalid UTF-8 affects one line only. Without the limits, a
    small compressed file could fill the memory.

    Raises:
        DatasetError: the file cannot be read, a line has more bytes than the limit with its line
            end, or all lines exceed `MAX_BYTES`.
    """
    opener = gzip.open if path.suffix == ".gz" else open
    try:
        with opener(path, "rb") as file:
            number = size = 0
            while line := file.readline(limit + 1):
                number, size = number + 1, size + len(line)
                check_size(path, size, MAX_BYTES)
                if len(line) > limit:
                    raise DatasetError(
                        path, f"line {number}", f"the line is longer than {limit} bytes"
                    )
                yield line
    except (OSError, EOFError, zlib.error) as error:
        raise DatasetError(path, "", f"cannot be read: {error}") from error


def check_size(path: Path, size: int, limit: int) -> None:
    """Raise DatasetError if a file has more bytes than the limit, after decompression."""
    if size > limit:
        raise DatasetError(path, "", f"is larger than {limit // 2**20} MiB after decompression")


def load_json(path: Path) -> Any:
    """Read a JSON file of at most `MAX_BYTES`, or raise a DatasetError."""
    try:
        check_size(path, path.stat().st_size, MAX_BYTES)
        return json.loads(path.read_text(encoding="utf-8"), parse_int=bounded_int)
    except DatasetError:
        raise
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(path, "", f"cannot be read: {error}") from error
    except json.JSONDecodeError as error:
        raise DatasetError(path, f"line {error.lineno}", f"is not JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise DatasetError(path, "", f"is not JSON: {error}") from error


def bounded_int(digits: str) -> int:
    """Parse an integer for `json.loads`. Above `MAX_DIGITS` digits, float() could overflow."""
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"an integer of {len(digits)} digits is too long: {digits[:10]}…")
    return int(digits)


@contextmanager
def located(path: Path, where: str) -> Iterator[None]:
    """Convert a TypeError or ValueError in the `with` block to a DatasetError with its place."""
    try:
        yield
    except DatasetError:
        raise
    except (TypeError, ValueError) as error:
        raise DatasetError(path, where, str(error)) from error


def take(path: Path, where: str, values: Any, name: str, kind: type | tuple[type, ...]) -> Any:
    """Return the field ``name`` of a JSON object, or raise a DatasetError if its type differs."""
    if not isinstance(values, dict):
        raise DatasetError(path, where, f"must be an object, not {type(values).__name__}")
    if name not in values:
        raise DatasetError(path, where, f"lacks {name!r}")
    value = values[name]
    if not isinstance(value, kind) or isinstance(value, bool):
        names = kind.__name__ if isinstance(kind, type) else " or ".join(k.__name__ for k in kind)
        raise DatasetError(path, where, f"{name!r} must be of type {names}, not {value!r}")
    return value
