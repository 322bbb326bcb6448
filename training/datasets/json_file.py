"""Reading JSON files whose layout others decided, with errors that say where."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from training.datasets.records import DatasetError

MAX_DIGITS: Final = 30


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
