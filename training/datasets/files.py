"""Reading files that others wrote, within bounds, with errors that say where."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from training.datasets.records import DatasetError

MAX_DIGITS: Final = 30


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


def load_json(path: Path) -> Any:
    """The content of a JSON file.

    Raises:
        DatasetError: it cannot be read, or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"), parse_int=bounded_int)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(path, "", f"cannot be read: {error}") from error
    except json.JSONDecodeError as error:
        raise DatasetError(path, f"line {error.lineno}", f"not JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise DatasetError(path, "", f"not JSON: {error}") from error


def bounded_int(digits: str) -> int:
    """An integer of a JSON file, for ``parse_int``.

    Raises:
        ValueError: it has more than `MAX_DIGITS` digits; longer ones overflow where floats are due.
    """
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits starts with {digits[:10]}")
    return int(digits)


@contextmanager
def located(path: Path, where: str) -> Iterator[None]:
    """Errors of what is built within become DatasetErrors that say where."""
    try:
        yield
    except DatasetError:
        raise
    except (TypeError, ValueError) as error:
        raise DatasetError(path, where, str(error)) from error


def take(path: Path, where: str, values: Any, name: str, kind: type | tuple[type, ...]) -> Any:
    """The field ``name`` of the JSON object at ``where``, of the given type.

    Raises:
        DatasetError: it is missing or of another type.
    """
    if not isinstance(values, dict):
        raise DatasetError(path, where, f"must be an object, not {type(values).__name__}")
    if name not in values:
        raise DatasetError(path, where, f"lacks {name!r}")
    value = values[name]
    if not isinstance(value, kind) or isinstance(value, bool):
        names = kind.__name__ if isinstance(kind, type) else " or ".join(k.__name__ for k in kind)
        raise DatasetError(path, where, f"{name!r} must be of type {names}, not {value!r}")
    return value
