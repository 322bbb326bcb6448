"""An immutable snapshot of all models of a store. A refresh replaces the whole snapshot."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from operator import itemgetter
from types import MappingProxyType
from typing import Final

from app.registry.artifact import Artifact
from app.registry.errors import OUTDATED, ArtifactError, StoreError
from app.registry.references import NOTHING, AliasTarget, Shipped, resolve_reference, version_key
from app.registry.store import Store

_logger = logging.getLogger("app.registry")


@dataclass(frozen=True, eq=False)
class ModelSet:
    """The state of a store by (name, version). Its errors were never raised, so hold no frames."""

    entries: Mapping[tuple[str, str], Artifact | ArtifactError]
    aliases: Mapping[str, AliasTarget]
    failure: StoreError | None = None  # why the store or its aliases could not be read
    shipped: Shipped = NOTHING

    @cached_property
    def versions(self) -> Mapping[str, tuple[str, ...]]:
        """Maps each model to its versions in ascending order, including unusable versions."""
        keys = sorted(self.entries, key=lambda key: (key[0], version_key(key[1])))
        return {name: tuple(v for _, v in group) for name, group in groupby(keys, itemgetter(0))}

    @cached_property
    def artifacts(self) -> Mapping[tuple[str, str], Artifact]:
        """Maps each usable (name, version) to its artifact."""
        return {key: e for key, e in self.entries.items() if isinstance(e, Artifact)}

    @cached_property
    def failures(self) -> Mapping[tuple[str, str], ArtifactError]:
        """Maps each unusable (name, version) to the reason."""
        return {key: e for key, e in self.entries.items() if isinstance(e, ArtifactError)}

    def resolve(self, reference: str) -> Artifact:
        """Return the model that an alias, `name` or `name@version` points at.

        A name, or an alias without a version, points at the newest usable version.

        Raises:
            ArtifactError: the version is not usable, or no version of the model is. The exception
                has the reason of this version or of the newest version.
            StoreError: the reference does not resolve (see `resolve_reference`), or the store could
                not be read.
        """
        try:
            names = self.shipped.names
            key = resolve_reference(reference, self.aliases, self._by_preference, names)
        except StoreError as error:
            is_absent = error.code in ("unknown_model", "replaced_model")
            if self.failure is not None and is_absent:
                raise StoreError(self.failure.code, self.failure.reason) from None
            raise
        entry = self.entries[key]
        if isinstance(entry, ArtifactError):
            raise ArtifactError(entry.code, f"{'@'.join(key)}: {entry.reason}")
        return entry

    def is_outdated(self, alias: str) -> bool:
        """Return whether an alias points at a model that only earlier releases could load."""
        try:
            self.resolve(alias)
        except (ArtifactError, StoreError) as error:
            return error.code in OUTDATED
        return False

    def _by_preference(self, name: str) -> list[str]:
        """Return the versions of a model in ascending order, unusable versions first."""
        return sorted(self.versions.get(name, ()), key=lambda v: (name, v) not in self.failures)


EMPTY: Final = ModelSet({}, {})
"""The state of a store without models."""


def load_model_set(
    store: Store,
    previous: ModelSet = EMPTY,
    check: Callable[[Artifact], None] = lambda _: None,
    release: Store | None = None,
) -> ModelSet:
    """Load and verify every version of a store. The result contains all errors.

    An artifact of the previous snapshot is verified again, and reused if its digest is unchanged.
    ``check`` raises `ArtifactError` for an unusable new artifact. The store ``release``, or without
    it the store itself, states which models this release replaces.
    """
    failure: StoreError | None = None
    aliases: Mapping[str, AliasTarget]
    try:
        # Aliases are read before versions. Writers publish a version before its alias, so the list
        # of versions contains the target of each alias.
        aliases = store.aliases()
    except StoreError as error:
        aliases, failure = {}, StoreError(error.code, error.reason)
    keys: list[tuple[str, str]] = []
    try:
        names = store.names()
    except StoreError as error:
        names, failure = [], StoreError(error.code, error.reason)
    for name in names:
        try:
            keys += [(name, version) for version in store.versions(name)]
        except StoreError as error:  # only this model's folder is unreadable
            failure = StoreError(error.code, error.reason)
    statements = (_statement(source) for source in (release, store) if source is not None)
    shipped = next((statement for statement in statements if statement != NOTHING), NOTHING)
    entries = {key: _load(store, *key, previous.artifacts.get(key), check, shipped) for key in keys}
    return ModelSet(MappingProxyType(entries), MappingProxyType(dict(aliases)), failure, shipped)


def with_default(
    models: ModelSet,
    release: Store,
    previous: ModelSet = EMPTY,
    check: Callable[[Artifact], None] = lambda _: None,
) -> ModelSet:
    """Add the default model of the release, if an outdated alias needs it and it is missing."""
    if models.shipped.default is None or not any(map(models.is_outdated, models.aliases)):
        return models
    try:
        key = release.resolve(str(models.shipped.default))
    except StoreError:  # the release has no models
        return models
    if key in models.entries:
        return models
    new = _load(release, *key, previous.artifacts.get(key), check, models.shipped)
    return replace(models, entries=MappingProxyType({**models.entries, key: new}))


def _statement(store: Store) -> Shipped:
    try:
        return store.shipped()
    except StoreError:  # `load_model_set` reports the error of the store itself
        return NOTHING


def _load(
    store: Store,
    name: str,
    version: str,
    previous: Artifact | None,
    check: Callable[[Artifact], None],
    shipped: Shipped,
) -> Artifact | ArtifactError:
    """Return a verified version of the store, or the error that makes it unusable."""
    try:
        artifact = store.load(name, version, previous)
        if artifact is not previous:
            check(artifact)
        return artifact
    except ArtifactError as error:
        if error.code == "outdated_format":
            new = shipped.replacement(name, version, store.digest(name, version))
            if new is not None:
                reason = f"'{new}' replaces this version, whose format is too old for this release"
                return ArtifactError("replaced_model", reason)
        return ArtifactError(error.code, error.reason)
    except StoreError as error:  # for example, the version was removed after it was listed
        return ArtifactError("missing_file", error.reason)
    except Exception as error:
        # This includes MemoryError, because other versions may need less memory.
        _logger.exception("%s@%s could not be loaded", name, version)
        kind = type(error).__name__
        reason = f"loading failed with {kind}; see the traceback in the service's log"
        return ArtifactError("unexpected_error", reason)
