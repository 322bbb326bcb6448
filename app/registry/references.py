"""Names, versions and aliases: the valid spellings, the order of versions, and references.

A reference is an alias, `name` (the newest usable version of the model) or `name@version`. Every
valid name is also a safe file name, because it is in lower case, without path separators or dots.

The table of aliases is a small JSON file that maps each alias to a model version. Each change of an
alias replaces the whole file. The table of the shipped store also states the default of the release
and which models of earlier releases it replaces. Format of the file, with `_shipped` optional:

    {"default": {"name": "...", "version": "..." or null for the newest usable version},
     "_shipped": {"default": {"name": "...", "version": "..."},
                  "replaced": {"OLD": {"by": "NEW", "digests": {"VERSION": "..."}}}}}
"""

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, NamedTuple, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, TypeAdapter, ValidationError

from app.model.fields import Sha256
from app.registry.durable import read_file
from app.registry.errors import OUTDATED, StoreError, cause

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


class Replacement(BaseModel):
    """The model that replaces a shipped model of an earlier release."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    by: ModelName
    digests: dict[Version, Sha256] = {}  # of the replaced versions; other versions are own models


class Shipped(BaseModel):
    """The statement of a release about its shipped models."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    default: AliasTarget | None = None  # the version that answers instead of an outdated own model
    replaced: dict[ModelName, Replacement] = {}

    @property
    def names(self) -> dict[str, str]:
        """Maps the name of each replaced model to the name of the new model."""
        return {old: replacement.by for old, replacement in self.replaced.items()}

    def replacement(self, name: str, version: str, digest: str | None) -> str | None:
        """Return the name of the model that replaces a version, or None for any other version."""
        if (entry := self.replaced.get(name)) is None or digest is None:
            return None
        return entry.by if entry.digests.get(version) == digest else None


NOTHING: Final = Shipped()
"""The statement of a store that is not a shipped one."""


class AliasTable(NamedTuple):
    """The contents of the file: the target of each alias, and the statement of the release."""

    aliases: dict[str, AliasTarget]
    shipped: Shipped = NOTHING


_SHIPPED: Final = "_shipped"  # never an alias, because names start with a-z or 0-9
_MEMBERS: Final = TypeAdapter(dict[str, Any])
_ALIASES: Final = TypeAdapter(dict[ModelName, AliasTarget])


def version_key(version: str) -> tuple[int, ...]:
    """Return the sort key of a version: its three numbers."""
    return tuple(int(part) for part in version.split("."))


def resolve_reference(
    reference: str,
    aliases: Mapping[str, AliasTarget],
    versions: Callable[[str], Sequence[str]],
    replaced: Mapping[str, str] = MappingProxyType({}),
) -> tuple[str, str]:
    """Return the (name, version) that an alias, `name` or `name@version` points at.

    An alias takes precedence over a model of its name. A name points at the last of its
    ``versions``. ``replaced`` maps the names of replaced models to those of the new models.

    Raises:
        StoreError: `invalid_reference`, `unknown_model`, `replaced_model`, `unknown_version`, or
            `dangling_alias` if the target of an alias does not exist and is not replaced.
    """
    pick = partial(_pick, versions=versions, replaced=replaced)
    name, at, version = reference.partition("@")
    NAME.check(name, "model name")
    if at:
        return pick(AliasTarget(name=name, version=VERSION.check(version, "version")))
    if (target := aliases.get(name)) is None:
        return pick(AliasTarget(name=name))
    try:
        return pick(target)
    except StoreError as error:
        reason = f"the target of alias '{name}' does not exist: {error.reason}"
        code = error.code if error.code in OUTDATED else "dangling_alias"
        raise StoreError(code, reason) from None


def _pick(
    target: AliasTarget, versions: Callable[[str], Sequence[str]], replaced: Mapping[str, str]
) -> tuple[str, str]:
    """Return the (name, version) of a target, without a version the newest one."""
    if not (published := versions(target.name)):
        if (new := replaced.get(target.name)) is not None:
            raise StoreError("replaced_model", f"'{new}' replaces the model '{target.name}'")
        raise StoreError("unknown_model", f"no model or alias has the name '{target.name}'")
    if target.version is None:
        return target.name, published[-1]
    if target.version not in published:
        reason = f"model '{target.name}' does not have version {target.version}"
        raise StoreError("unknown_version", reason)
    return target.name, target.version


def read_table(path: Path) -> AliasTable:
    """Return the contents of the file. The table is empty if the file does not exist.

    Raises:
        StoreError: `invalid_aliases` if the file is not a valid table of aliases.
    """
    try:
        text = read_file(path, MAX_ALIASES_BYTES)
        if len(text) > MAX_ALIASES_BYTES:
            reason = f"{path.name} has more than the maximum of {MAX_ALIASES_BYTES} bytes"
            raise StoreError("invalid_aliases", reason)
        members = _MEMBERS.validate_json(text)
        shipped = Shipped.model_validate(members.pop(_SHIPPED, {}))
        return AliasTable(_ALIASES.validate_python(members), shipped)
    except FileNotFoundError:
        return AliasTable({})
    except OSError as error:
        raise StoreError("invalid_aliases", f"{path.name} cannot be read: {cause(error)}") from None
    except ValidationError as error:
        detail = error.errors(include_url=False, include_input=False, include_context=False)[0]
        reason = f"{path.name} is not a valid table of aliases: {detail['msg']}"
        raise StoreError("invalid_aliases", reason) from None


def aliases_to_bytes(aliases: Mapping[str, AliasTarget], shipped: Shipped = NOTHING) -> bytes:
    """Return the contents of the file for a table of aliases.

    Raises:
        StoreError: `not_writable` if `read_table` would refuse the size of the file.
    """
    members: dict[str, BaseModel] = dict(sorted(aliases.items()))
    if shipped != NOTHING:
        members[_SHIPPED] = shipped
    text = _MEMBERS.dump_json(members, indent=2) + b"\n"
    if len(text) > MAX_ALIASES_BYTES:
        limit = f"the maximum of {MAX_ALIASES_BYTES} bytes; remove an alias first"
        raise StoreError("not_writable", f"the table of aliases would have more than {limit}")
    return text
