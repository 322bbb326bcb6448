"""The store: published versions, which never change, and aliases that point at them.

    <root>/<name>/<version>/{model.safetensors, manifest.json, card.md}
    <root>/aliases.json

Readers need no lock, because a writer publishes a version or changes an alias by one atomic rename.
Only one writer at a time holds the lock. So a temporary file that a writer finds comes from a
crashed writer.
"""

import dataclasses
import os
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, TypeAlias

from numpy.typing import ArrayLike

from app.registry.artifact import (
    MAX_WEIGHTS_BYTES,
    Artifact,
    copy_artifact,
    load_artifact,
    manifest_digest,
    write_artifact,
)
from app.registry.description import Description
from app.registry.durable import exclusive, make_directory, rename, replace_file
from app.registry.errors import ArtifactError, StoreError, cause
from app.registry.manifest import CARD, MANIFEST, WEIGHTS
from app.registry.references import (
    NAME,
    VERSION,
    AliasTarget,
    Shipped,
    aliases_to_bytes,
    read_table,
    resolve_reference,
    version_key,
)
from app.registry.tensors import StorageDtype

DEFAULT_STORE: Final = "model_store"
"""Folder of the store without SCENE_STORE, as `Settings.store`."""

ALIASES: Final = "aliases.json"
_LOCK: Final = ".lock"
TEMPORARY: Final = ".publishing-"

StoreState: TypeAlias = tuple[tuple[str | int, ...], ...]


class Store:
    """A directory of published models. Only `publish` creates it."""

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        lock_timeout: float = 60.0,  # seconds that a writer waits for another writer
        max_weights_bytes: int = MAX_WEIGHTS_BYTES,
    ) -> None:
        self.root = Path(root)
        self._lock_timeout = lock_timeout
        self._max_weights_bytes = max_weights_bytes

    def names(self) -> list[str]:
        """Return the model names in alphabetical order, or raise StoreError `unreadable`."""
        try:
            return sorted(entry.name for entry in self.root.iterdir() if NAME.fits(entry.name))
        except OSError as error:
            raise StoreError("unreadable", f"the store cannot be read: {cause(error)}") from None

    def versions(self, name: str) -> tuple[str, ...]:
        """Return the published versions of a model in ascending order. The result may be empty.

        A folder without a manifest is left out, because writers write the manifest last. Every
        other entry with the name of a version is in the result, so that `load` reports its error.

        Raises:
            StoreError: `invalid_reference`, or `unreadable`.
        """
        folder = self.root / NAME.check(name, "model name")
        if not _is_directory(folder):
            return ()
        try:
            entries = [entry.name for entry in folder.iterdir() if not _is_unfinished(entry)]
        except OSError as error:
            reason = f"the folder of model '{name}' cannot be read: {cause(error)}"
            raise StoreError("unreadable", reason) from None
        return tuple(sorted(filter(VERSION.fits, entries), key=version_key))

    def aliases(self) -> Mapping[str, AliasTarget]:
        """Return the target of each alias, or raise StoreError `invalid_aliases`."""
        return MappingProxyType(read_table(self.root / ALIASES).aliases)

    def shipped(self) -> Shipped:
        """Return the statement about shipped models, or raise StoreError `invalid_aliases`."""
        return read_table(self.root / ALIASES).shipped

    def digest(self, name: str, version: str) -> str | None:
        """Return the unverified digest of a version of any format, or None if it is unreadable."""
        return manifest_digest(self.root / NAME.check(name, "model name") / version)

    def resolve(self, reference: str) -> tuple[str, str]:
        """Return the (name, version) that an alias, `name` or `name@version` points at.

        Raises:
            StoreError: see `resolve_reference`; also `invalid_aliases` or `unreadable`.
        """
        self.names()  # without a readable root, no name is unknown
        replaced = self.shipped().names
        return resolve_reference(reference, self.aliases(), self.versions, replaced)

    def load(self, name: str, version: str, previous: Artifact | None = None) -> Artifact:
        """Load and verify one version. Return ``previous`` if its digest is unchanged.

        Raises:
            ArtifactError: the artifact is not valid, or has another name or version.
            StoreError: `invalid_reference`, or `unknown_version`.
        """
        folder = self.root / NAME.check(name, "model name") / VERSION.check(version, "version")
        exists = _is_directory(folder.parent) and os.path.lexists(folder)
        if not exists or _is_unfinished(folder):
            raise StoreError("unknown_version", f"model '{name}' does not have version {version}")
        artifact = load_artifact(folder, previous, self._max_weights_bytes)
        stored = f"{artifact.manifest.name}@{artifact.manifest.version}"
        if stored != f"{name}@{version}":
            reason = f"the folder of {name}@{version} contains the manifest of {stored}"
            raise ArtifactError("wrong_place", reason)
        return artifact

    def state(self) -> StoreState:
        """Return metadata of files that changes whenever a version or an alias changes."""
        files = [self.root / ALIASES]
        with suppress(StoreError):
            for name in self.names():
                with suppress(StoreError):
                    folders = [self.root / name / version for version in self.versions(name)]
                    files += [f / file for f in folders for file in (MANIFEST, WEIGHTS, CARD)]
        return tuple((str(file), *_file_state(file)) for file in files)

    def require_new(self, name: str, version: str) -> None:
        """Check that a version can be published: its number is valid and new.

        Raises:
            StoreError: `version_exists`, `name_conflict`, `invalid_reference`, `invalid_aliases`,
                or `unreadable`.
        """
        VERSION.check(version, "version")
        if name in self.aliases():
            reason = f"'{name}' is the name of an alias, so it cannot be the name of a model"
            raise StoreError("name_conflict", reason)
        if version in (published := self.versions(name)):
            advice = f"Choose a new number; the newest version is {published[-1]}"
            reason = f"{name}@{version} is already published, and a version never changes. {advice}"
            raise StoreError("version_exists", reason)

    def publish(
        self,
        description: Description,
        state: Mapping[str, ArrayLike],
        *,
        storage_dtype: StorageDtype = "float32",
    ) -> Artifact:
        """Publish a version permanently from its tensors, ``state``. Return the artifact.

        Raises:
            ArtifactError: the artifact is not valid.
            StoreError: `version_exists`, `name_conflict`, `invalid_reference`, `invalid_aliases`,
                `unsafe_path`, `locked`, or `not_writable`.
        """

        def write(folder: Path) -> None:
            write_artifact(folder, description, state, storage_dtype=storage_dtype)

        with self._writing(creates=True):
            return self._add(description.name, description.version, write)

    def copy(self, source: "Store", name: str, version: str) -> bool:
        """Copy a version of another store, and return whether it is new to this store.

        A version that this store already has with the same digest stays unchanged.

        Raises:
            ArtifactError: the version is not valid in ``source``, or in this store.
            StoreError: `version_exists` if this store has another version of this number;
                `unknown_version`, or an error of `publish`.
        """
        artifact = source.load(name, version)
        with self._writing():
            if version not in self.versions(name):
                self._add(name, version, lambda folder: copy_artifact(artifact, folder))
                return True
            try:
                own = self.load(name, version)
            except ArtifactError as error:
                advice = f"Remove its folder {name}/{version}, then copy again"
                reason = f"the copy of {name}@{version} is damaged: {error.reason}. {advice}"
                raise ArtifactError(error.code, reason) from None
        if own.digest != artifact.digest:
            digests = f"{own.digest[:12]}, not {artifact.digest[:12]}"
            reason = f"{name}@{version} is already published with the digest {digests}"
            raise StoreError("version_exists", f"{reason}, and a version never changes")
        return False

    def _add(self, name: str, version: str, write: Callable[[Path], object]) -> Artifact:
        """Add a version whose folder ``write`` creates. The caller holds the lock."""
        self.require_new(name, version)
        folder = self.root / name
        if os.path.lexists(folder) and not _is_directory(folder):
            raise StoreError("unsafe_path", f"the path of model '{name}' is not a directory")
        make_directory(folder)
        path = folder / version
        if os.path.lexists(path):
            advice = "Choose a new number, or remove the folder"
            reason = f"{name}/{version} is a folder without a manifest. {advice}"
            raise StoreError("version_exists", reason)
        temporary = folder / f"{TEMPORARY}{version}"
        try:
            write(temporary)
            artifact = load_artifact(temporary, None, self._max_weights_bytes)
            rename(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        return dataclasses.replace(artifact, path=path)

    def set_alias(
        self,
        alias: str,
        target: AliasTarget,
        *,
        expected: AliasTarget | Literal["any"] | None = "any",
    ) -> None:
        """Point an alias at a version, or at the newest usable version of a model.

        Before the change, the alias must have the ``expected`` target; None: it must not exist.

        Raises:
            StoreError: `alias_conflict` if the current target is not ``expected``; `not_writable`,
                also if the table of aliases would be too large for readers; `unknown_model`;
                `unknown_version`; `name_conflict`; `invalid_reference`; `invalid_aliases`; `locked`
        """
        NAME.check(alias, "alias")
        with self._writing():
            if self.versions(alias):
                reason = f"'{alias}' is the name of a model, so it cannot be the name of an alias"
                raise StoreError("name_conflict", reason)
            current = self.aliases().get(alias)  # None for a missing alias
            if expected not in ("any", current):
                targets = f"{current or 'nothing'}, not at {expected or 'nothing'}"
                raise StoreError("alias_conflict", f"alias '{alias}' points at {targets}")
            resolve_reference(str(target), {}, self.versions)  # raises without such a target
            self._write_table({**self.aliases(), alias: target})

    def remove_alias(self, alias: str) -> None:
        """Remove an alias. The errors are those of `set_alias`."""
        NAME.check(alias, "alias")
        with self._writing():
            table = dict(self.aliases())
            if table.pop(alias, None) is None:
                raise StoreError("unknown_model", f"no alias has the name '{alias}'")
            self._write_table(table)

    def _write_table(self, aliases: Mapping[str, AliasTarget]) -> None:
        text = aliases_to_bytes(aliases, self.shipped())
        replace_file(self.root / ALIASES, text, prefix=TEMPORARY)

    @contextmanager
    def _writing(self, *, creates: bool = False) -> Iterator[None]:
        """Hold the lock of the store, and remove temporary files of crashed writers."""
        try:
            if creates:
                make_directory(self.root)
            with exclusive(self.root / _LOCK, self._lock_timeout):
                self._clear_leftovers()
                yield
        except OSError as error:
            reason = f"the store cannot be written: {cause(error)}"
            raise StoreError("not_writable", reason) from error

    def _clear_leftovers(self) -> None:
        """Remove the temporary files and folders of writers that crashed."""
        folders = (self.root / name for name in self.names())
        for folder in (self.root, *filter(_is_directory, folders)):
            for entry in folder.glob(f"{TEMPORARY}*"):
                if _is_directory(entry):
                    shutil.rmtree(entry)
                else:
                    entry.unlink()


def _file_state(path: Path) -> tuple[int, ...]:
    """Return the inode, size and modification time of a file, or () for a missing file."""
    try:
        status = path.lstat()
    except OSError:
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns


def _is_unfinished(version: Path) -> bool:
    """Return whether a version is a readable folder without a manifest."""
    is_readable = _is_directory(version) and os.access(version, os.X_OK)
    return is_readable and not os.path.lexists(version / MANIFEST)


def _is_directory(path: Path) -> bool:
    """Return whether a path is a directory. A link to a directory does not count."""
    try:
        return stat.S_ISDIR(path.lstat().st_mode)
    except OSError:
        return False
