"""Everything the store holds, loaded: an immutable snapshot that a service swaps as a whole."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

from app.registry.artifact import Artifact
from app.registry.errors import ArtifactCode, ArtifactError, RegistryError, StoreCode, StoreError
from app.registry.references import AliasTarget, resolve_reference, version_key
from app.registry.store import Store

_logger = logging.getLogger("app.registry")


@dataclass(frozen=True, slots=True)
class ArtifactFailure:
    """Why a version was refused. Unlike an exception it keeps no frames and no weights alive."""

    code: ArtifactCode
    reason: str


@dataclass(frozen=True, slots=True)
class StoreFailure:
    """Why the store itself, or its table of aliases, could not be read."""

    code: StoreCode
    reason: str


@dataclass(frozen=True, eq=False)
class ModelSet:
    """The state of a store at one moment.

    Attributes:
        entries: each published (name, version): its artifact, or why it was refused.
        aliases: what each points at.
        failure: set where the store or its aliases could not be read.
    """

    entries: Mapping[tuple[str, str], Artifact | ArtifactFailure]
    aliases: Mapping[str, AliasTarget]
    failure: StoreFailure | None = None

    @cached_property
    def versions(self) -> Mapping[str, tuple[str, ...]]:
        """Versions of each model, ascending; refused ones too."""
        found: dict[str, list[str]] = {}
        for name, version in sorted(self.entries, key=lambda key: (key[0], version_key(key[1]))):
            found.setdefault(name, []).append(version)
        return MappingProxyType({name: tuple(versions) for name, versions in found.items()})

    @cached_property
    def failures(self) -> Mapping[tuple[str, str], ArtifactFailure]:
        """The versions that were refused."""
        return MappingProxyType(
            {key: e for key, e in self.entries.items() if isinstance(e, ArtifactFailure)}
        )

    def resolve(self, reference: str) -> Artifact:
        """The model that an alias, `name` or `name@version` points at.

        A refused version answers with its failure: no older one stands in for it.

        Raises:
            ArtifactError: the version was refused.
            StoreError: see `resolve_reference`; the store's own failure where it could not be read.
        """
        try:
            key = resolve_reference(
                reference, self.aliases, lambda name: self.versions.get(name, ())
            )
        except StoreError as error:
            if self.failure is not None and error.code == "unknown_model":
                raise StoreError(self.failure.code, self.failure.reason) from None
            raise
        entry = self.entries[key]
        if isinstance(entry, ArtifactFailure):
            name, version = key
            raise ArtifactError(entry.code, f"{name}@{version}: {entry.reason}")
        return entry

    @cached_property
    def default_failure(self) -> str | None:
        """Why requests that name no model cannot be answered; None where they can."""
        try:
            self.resolve("default")
        except RegistryError as error:
            return str(error)
        return None

    @property
    def ready(self) -> bool:
        """Whether requests that name no model can be answered."""
        return self.default_failure is None


def load_model_set(store: Store, previous: ModelSet | None = None) -> ModelSet:
    """Load and verify every version of a store.

    Never raises for what the store holds: a refused version, unreadable aliases or a missing store
    are part of the result. Artifacts of `previous` whose digest is unchanged are taken over as they
    are, after their files were verified again.
    """
    failure: StoreFailure | None = None
    aliases: Mapping[str, AliasTarget]
    try:
        # Before the versions: an alias moves after its version appears, so each target is listed.
        aliases = store.aliases()
    except StoreError as error:
        aliases, failure = {}, StoreFailure(error.code, error.reason)
    keys: list[tuple[str, str]] = []
    try:
        for name in store.names():
            try:
                keys += [(name, version) for version in store.versions(name)]
            except StoreError as error:  # one model's folder; the others still answer
                failure = StoreFailure(error.code, error.reason)
    except StoreError as error:
        failure = StoreFailure(error.code, error.reason)
    known = previous.entries if previous is not None else {}
    entries = {key: _load(store, *key, known.get(key)) for key in keys}
    return ModelSet(MappingProxyType(entries), MappingProxyType(dict(aliases)), failure)


def _load(
    store: Store, name: str, version: str, known: Artifact | ArtifactFailure | None
) -> Artifact | ArtifactFailure:
    try:
        return store.load(name, version, known if isinstance(known, Artifact) else None)
    except ArtifactError as error:
        return ArtifactFailure(error.code, error.reason)
    except StoreError as error:  # removed by hand since it was listed
        return ArtifactFailure("missing_file", error.reason)
    except Exception as error:
        # MemoryError is one of them: this version needs more than there is, the others do not.
        _logger.exception("%s@%s could not be loaded", name, version)
        return ArtifactFailure(
            "unexpected_error", f"loading failed with {type(error).__name__}; the log says why"
        )
