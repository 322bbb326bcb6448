"""Guards against hostile input: texts of others as single lines, and files of any kind and size."""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO, Final, TypeVar

from pydantic import BaseModel

ModelT = TypeVar("ModelT", bound=BaseModel)

# The standard input, or another file that the caller has already opened for this process.
_OPENED: Final = re.compile(r"/dev/stdin|/dev/fd/\d+|/proc/self/fd/\d+")


# -------------------------------------------------------------------------------------- texts


def printable(text: str) -> str:
    """Return a text as one line, with an escape in place of each unprintable character.

    These are control characters, line breaks, and marks that change the direction of text: a
    terminal would run, forge or hide a part of the line.
    """
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)


def printable_lines(text: str) -> str:
    """Return a text whose lines are `printable`. Each line break must be one of the caller."""
    return "\n".join(map(printable, text.split("\n")))


def printable_json(text: str) -> str:
    r"""Return a JSON text with `\uXXXX` in place of each unprintable character. Its value stays."""
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else json.dumps(one)[1:-1] for one in text)


def shortened(text: str, most: int) -> str:
    """Return a text with at most ``most`` characters. The end of a longer text becomes "…"."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def printable_answer(answer: ModelT, most: int = sys.maxsize) -> ModelT:
    """Return an answer of the service whose texts are `printable`, and `shortened` to ``most``."""

    def cleaned(value: Any) -> Any:
        if isinstance(value, str):
            return shortened(printable(value[: most + 1]), most)
        if isinstance(value, dict):
            return {cleaned(name): cleaned(part) for name, part in value.items()}
        return [*map(cleaned, value)] if isinstance(value, list | tuple) else value

    return type(answer).model_validate(cleaned(answer.model_dump(exclude_unset=True)))


# -------------------------------------------------------------------------------------- files


@contextmanager
def regular_file(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a regular file for reading. A pipe is accepted if the process has it open already.

    Such a pipe has a name like ``/dev/stdin``. Opening another pipe would wait for its writer.

    Raises:
        OSError: the file cannot be opened, or is a pipe, a device or a socket.
    """
    with open(path, "rb", opener=_opened) as file:
        if _OPENED.fullmatch(os.fspath(path)):
            os.set_blocking(file.fileno(), True)
        elif not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file")
        yield file


def _opened(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_regular(path: str | os.PathLike[str], most: int) -> bytes:
    """Return the content of a file that `regular_file` opens, with at most ``most`` bytes.

    Raises:
        OSError: the file cannot be read, or is too large.
    """
    with regular_file(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise OSError(errno.EFBIG, f"it is too large: it has more than {most} bytes")
    return content
