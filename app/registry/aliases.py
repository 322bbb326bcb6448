"""The table of aliases: a small JSON file that maps each alias to a model version.

Each change of an alias replaces the whole file. Format of the file:

    {"default": {"name": "...", "version": "..." or null for the latest version}}
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter, ValidationError

from app.registry.durable import replace_file
from app.registry.errors import StoreError, cause
from app.registry.references import AliasTarget, ModelName

MAX_ALIASES_BYTES: Final = 256 * 2**10

_TABLE: Final = TypeAdapter(dict[ModelName, AliasTarget])


def read_aliases(path: Path) -> dict[str, AliasTarget]:
    """Return the target of each alias. The result is empty if the file does not exist.

    Raises:
        StoreError: `invalid_aliases` if the file is not a valid table of aliases.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            text = file.read(MAX_ALIASES_BYTES + 1)
        if len(text) > MAX_ALIASES_BYTES:
            raise StoreError(
                "invalid_aliases",
                f"{path.name} has more than the maximum of {MAX_ALIASES_BYTES} bytes",
            )
        return _TABLE.validate_json(text)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise StoreError("invalid_aliases", f"{path.name} cannot be read: {cause(error)}") from None
    except ValidationError as error:
        detail = error.errors(include_url=False, include_input=False, include_context=False)[0]
        raise StoreError(
            "invalid_aliases", f"{path.name} is not a valid table of aliases: {detail['msg']}"
        ) from None


def write_aliases(path: Path, aliases: Mapping[str, AliasTarget], *, prefix: str) -> None:
    """Replace the table of aliases.

    The function writes a temporary file and renames it. A crash may leave the temporary file
    behind.

    Args:
        path: the file of the table.
        aliases: maps each alias to its target.
        prefix: start of the temporary file's name.
    """
    table = dict(sorted(aliases.items()))
    replace_file(path, _TABLE.dump_json(table, indent=2) + b"\n", prefix=prefix)
