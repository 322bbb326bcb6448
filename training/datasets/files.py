"""Read data files with size limits. Each error names the file, and its position or the limit."""

from __future__ import annotations

import gzip
import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class Node:
    """A value in a file, and its position, such as ``scans[3].objects``."""

    path: Path
    value: Any
    where: str = ""

    def take(self, name: str, kind: type | tuple[type, ...] = object) -> Any:
        """Return a field of a JSON object, or raise a DatasetError if its type differs."""
        if not isinstance(self.value, dict):
            raise self.error(f"must be an object, not {type(self.value).__name__}")
        if name not in self.value:
            raise self.error(f"lacks {name!r}")
        value = self.value[name]
        if not isinstance(value, kind) or isinstance(value, bool):
            kinds = (kind,) if isinstance(kind, type) else kind
            names = " or ".join(k.__name__ for k in kinds)
            raise self.error(f"{name!r} must be of type {names}, not {value!r}")
        return value

    def entries(self, name: str) -> list[Node]:
        """Return the entries of the list in a field of a JSON object."""
        start = f"{self.where}.{name}" if self.where else name
        entries = enumerate(self.take(name, list))
        return [Node(self.path, entry, f"{start}[{number}]") for number, entry in entries]

    def error(self, problem: object) -> DatasetError:
        """Return an error that names the file and the position."""
        return DatasetError(self.path, self.where, str(problem))

    @contextmanager
    def located(self) -> Iterator[None]:
        """Convert a TypeError or ValueError in the `with` block to a DatasetError."""
        try:
            yield
        except DatasetError:
            raise
        except (TypeError, ValueError) as error:
            raise self.error(error) from error


def load_json(path: Path) -> Node:
    """Read a JSON file of at most `MAX_BYTES`, or raise a DatasetError."""
    try:
        check_size(path, path.stat().st_size, MAX_BYTES)
        return Node(path, json.loads(path.read_text(encoding="utf-8"), parse_int=bounded_int))
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
