"""The table of aliases: a small JSON file that maps each alias to a model version.

Each change of an alias replaces the whole file. Format of the file:

    {"default": {"name": "...", "version": "..." or null for the newest usable version}}
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import TypeAdapter, ValidationError

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


def aliases_to_bytes(aliases: Mapping[str, AliasTarget]) -> bytes:
    """Return the contents of the file for a table of aliases.

    Raises:
        StoreError: `not_writable` if `read_aliases` would refuse the size of the file.
    """
    text = _TABLE.dump_json(dict(sorted(aliases.items())), indent=2) + b"\n"
    if len(text) > MAX_ALIASES_BYTES:
        raise StoreError(
            "not_writable",
            f"the table of aliases would have more than the maximum of {MAX_ALIASES_BYTES} bytes; "
            "remove an alias first",
        )
    return text
