"""Read data files with size limits, and write files whole. Errors name the file and the place."""

from __future__ import annotations

import gzip
import os
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

from pydantic import TypeAdapter, ValidationError

from scene_client.untrusted import regular_file
from training.datasets.records import DatasetError

T = TypeVar("T")

MAX_BYTES: Final = 2**30  # maximum size of a text file in bytes, after decompression
DATA: Final = Path("../shared/data")  # default folder of the shipped data sources
KNOWLEDGE: Final = Path(__file__).resolve().parents[1] / "knowledge"
"""Folder of the written tables, which the repository contains."""


def read_lines(path: Path, limit: int) -> Iterator[bytes]:
    """Yield the undecoded lines of a file, plain or ``*.gz``: invalid UTF-8 affects one line only.

    Raises:
        DatasetError: the file cannot be read, is a pipe other than the standard input, a line with
            its end has more bytes than the limit, or all lines exceed `MAX_BYTES`: a small
            compressed file could fill the memory.
    """
    try:
        with regular_file(path) as plain, ExitStack() as stack:
            file: BinaryIO | gzip.GzipFile = plain
            if path.suffix == ".gz":
                file = stack.enter_context(gzip.open(plain))
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
        raise DatasetError.unreadable(path, error) from error


def check_size(path: Path, size: int, limit: int) -> None:
    """Raise DatasetError if a file has more bytes than the limit, after decompression."""
    if size > limit:
        raise DatasetError(path, "", f"is larger than {limit // 2**20} MiB after decompression")


def write_whole(path: Path, text: str) -> None:
    """Replace a file atomically. If the process is interrupted, the earlier file is kept."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(path.name + ".part")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def read_json(path: Path, content: type[T]) -> T:
    """Read a JSON file of at most `MAX_BYTES`, whose content has the given type.

    Raises:
        DatasetError: the file cannot be read, is not JSON or has another type at a named position.
    """
    try:
        with regular_file(path) as file:
            check_size(path, os.fstat(file.fileno()).st_size, MAX_BYTES)
            text = file.read()
        return TypeAdapter(content).validate_json(text)
    except OSError as error:
        raise DatasetError.unreadable(path, error) from error
    except ValidationError as error:
        raise DatasetError(path, *position_and_problem(error)) from error


def position_and_problem(error: ValidationError) -> tuple[str, str]:
    """Return the position of the first invalid value, "" for the whole, and what is wrong."""
    first = error.errors(include_url=False, include_input=False)[0]
    return ".".join(map(str, first["loc"])), first["msg"].removeprefix("Value error, ")
