"""Names, versions and aliases: the valid spellings, the order of versions, and references.

A reference is an alias, `name` (the newest usable version of the model) or `name@version`. Every
valid name is also a safe file name, because it is in lower case, without path separators or dots.

The table of aliases is a small JSON file that maps each alias to a model version. Each change of an
alias replaces the whole file. Format of the file:

    {"default": {"name": "...", "version": "..." or null for the newest usable version}}
"""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, TypeAdapter, ValidationError

from app.registry.durable import read_file
from app.registry.errors import StoreError, cause

MAX_ALIASES_BYTES: Final = 256 * 2**10


class Spelling(NamedTuple):
    """The valid spelling of a text, as a pattern and in words."""

    pattern: re.Pattern[str]
    rule: str

    def fits(self, text: str) -> bool:
        """Return whether a text is valid."""
        return self.pattern.fullmatch(text) is not None

    def require(self, text: str) -> str:
        """Return a valid text unchanged. Raise ValueError for another text."""
        if not self.fits(text):
            raise ValueError(self.rule)
        return text

    def check(self, text: str, what: str) -> str:
        """Return a valid text unchanged. Raise StoreError `invalid_reference` for another text."""
        if not self.fits(text):
            raise StoreError("invalid_reference", f"a {what} {self.rule}")
        return text


NAME: Final = Spelling(
    re.compile(r"[a-z0-9](?:[a-z0-9_-]{0,62}[a-z0-9])?"),
    "must have 1 to 64 characters a-z, 0-9, '_' or '-', and must start and end with a-z or 0-9",
)
"""Names of models and aliases."""
VERSION: Final = Spelling(
    re.compile(r"(?:0|[1-9][0-9]{0,8})(?:\.(?:0|[1-9][0-9]{0,8})){2}"),
    "must be MAJOR.MINOR.PATCH without leading zeros, for example 1.0.0",
)
ModelName = Annotated[str, AfterValidator(NAME.require)]
Version = Annotated[str, AfterValidator(VERSION.require)]


class AliasTarget(BaseModel):
    """The target of an alias: a version of a model, or None for its newest usable version."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: ModelName
    version: Version | None = None

    @classmethod
    def of(cls, reference: str) -> Self:
        """Return the target with the text `name` or `name@version`; ValueError if it is invalid."""
        name, at, version = reference.partition("@")
        return cls(name=name, version=version if at else None)

    def __str__(self) -> str:
        return self.name if self.version is None else f"{self.name}@{self.version}"


_TABLE: Final = TypeAdapter(dict[ModelName, AliasTarget])


def version_key(version: str) -> tuple[int, ...]:
    """Return the sort key of a version: its three numbers."""
    return tuple(int(part) for part in version.split("."))


def resolve_reference(
    reference: str, aliases: Mapping[str, AliasTarget], versions: Callable[[str], Sequence[str]]
) -> tuple[str, str]:
    """Return the (name, version) that an alias, `name` or `name@version` points at.

    Args:
        aliases: the target of each alias. An alias takes precedence over a model of its name.
        versions: returns the versions of a known model. Without a version, the last one is meant.

    Raises:
        StoreError: `invalid_reference`, `unknown_model`, `unknown_version`, or `dangling_alias` if
            the target of an alias does not exist.
    """
    name, at, version = reference.partition("@")
    NAME.check(name, "model name")
    if at:
        return _pick(AliasTarget(name=name, version=VERSION.check(version, "version")), versions)
    if (target := aliases.get(name)) is None:
        return _pick(AliasTarget(name=name), versions)
    try:
        return _pick(target, versions)
    except StoreError as error:
        reason = f"the target of alias '{name}' does not exist: {error.reason}"
        raise StoreError("dangling_alias", reason) from None


def _pick(target: AliasTarget, versions: Callable[[str], Sequence[str]]) -> tuple[str, str]:
    if not (published := versions(target.name)):
        raise StoreError("unknown_model", f"no model or alias has the name '{target.name}'")
    if target.version is None:
        return target.name, published[-1]
    if target.version not in published:
        reason = f"model '{target.name}' does not have version {target.version}"
        raise StoreError("unknown_version", reason)
    return target.name, target.version


def read_aliases(path: Path) -> dict[str, AliasTarget]:
    """Return the target of each alias. The result is empty if the file does not exist.

    Raises:
        StoreError: `invalid_aliases` if the file is not a valid table of aliases.
    """
    try:
        text = read_file(path, MAX_ALIASES_BYTES)
        if len(text) > MAX_ALIASES_BYTES:
            reason = f"{path.name} has more than the maximum of {MAX_ALIASES_BYTES} bytes"
            raise StoreError("invalid_aliases", reason)
        return _TABLE.validate_json(text)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise StoreError("invalid_aliases", f"{path.name} cannot be read: {cause(error)}") from None
    except ValidationError as error:
        detail = error.errors(include_url=False, include_input=False, include_context=False)[0]
        reason = f"{path.name} is not a valid table of aliases: {detail['msg']}"
        raise StoreError("invalid_aliases", reason) from None


def aliases_to_bytes(aliases: Mapping[str, AliasTarget]) -> bytes:
    """Return the contents of the file for a table of aliases.

    Raises:
        StoreError: `not_writable` if `read_aliases` would refuse the size of the file.
    """
    text = _TABLE.dump_json(dict(sorted(aliases.items())), indent=2) + b"\n"
    if len(text) > MAX_ALIASES_BYTES:
        limit = f"the maximum of {MAX_ALIASES_BYTES} bytes; remove an alias first"
        raise StoreError("not_writable", f"the table of aliases would have more than {limit}")
    return text
