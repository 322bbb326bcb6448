"""The store: published versions, which never change, and the aliases that point at them.

    <root>/<name>/<version>/{model.safetensors, manifest.json, card.md}
    <root>/aliases.json

Readers take no lock: a version appears by one rename, and an alias moves by one. Writers exclude
each other, so whatever temporary file a writer finds was left by a dead one.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from types import MappingProxyType
from typing import Final, Literal, TypeAlias

from numpy.typing import ArrayLike

from app.registry.aliases import read_aliases, write_aliases
from app.registry.artifact import Artifact, load_artifact, write_artifact
from app.registry.description import Description
from app.registry.durable import make_directory, rename
from app.registry.errors import ArtifactError, StoreError, cause
from app.registry.locking import exclusive
from app.registry.manifest import CARD, MANIFEST, WEIGHTS
from app.registry.references import (
    AliasTarget,
    check_name,
    check_version,
    is_name,
    is_version,
    resolve_reference,
    version_key,
)
from app.registry.tensors import StorageDtype
from app.registry.verified import MAX_WEIGHTS_BYTES

_ALIASES: Final = "aliases.json"
_LOCK: Final = ".lock"
_TEMPORARY: Final = ".publishing-"


StoreState: TypeAlias = tuple[tuple[str | int, ...], ...]


class Store:
    """A directory of published models.

    Args:
        root: need not exist before the first publication.
        lock_timeout: seconds that a writer waits for another.
        max_weights_bytes: versions with a larger weights file are refused.
    """

    def __init__(
        self,
        root: str | os.PathLike[str],
        *,
        lock_timeout: float = 60.0,
        max_weights_bytes: int = MAX_WEIGHTS_BYTES,
    ) -> None:
        self.root = Path(root)
        self._lock_timeout = lock_timeout
        self._max_weights_bytes = max_weights_bytes

    # -- reading --------------------------------------------------------------------------------

    def names(self) -> tuple[str, ...]:
        """Names of models with at least one version (or an unreadable folder), in order.

        Raises:
            StoreError: `unreadable` where the root is not a readable directory.
        """
        return tuple(name for name in self._folders() if self._may_hold_versions(name))

    def versions(self, name: str) -> tuple[str, ...]:
        """Published versions of a model, ascending; empty for an unknown model.

        A folder without a manifest is unfinished and does not count: the manifest is written last.
        Anything else under a version's name counts, so that a broken one is seen and reported.

        Raises:
            StoreError: `invalid_reference`, or `unreadable`.
        """
        folder = self.root / check_name(name)
        if not _is_directory(folder):
            return ()
        try:
            found = [entry.name for entry in folder.iterdir() if not _is_unfinished(entry)]
        except OSError as error:
            raise StoreError("unreadable", f"model '{name}': {cause(error)}") from None
        return tuple(sorted(filter(is_version, found), key=version_key))

    def latest(self, name: str) -> str:
        """The highest published version.

        Raises:
            StoreError: `invalid_reference`, `unreadable`, or `unknown_model`.
        """
        if not (found := self.versions(name)):
            raise StoreError("unknown_model", f"there is no model named '{name}'")
        return found[-1]

    def aliases(self) -> Mapping[str, AliasTarget]:
        """What each alias points at.

        Raises:
            StoreError: `invalid_aliases`.
        """
        return MappingProxyType(read_aliases(self.root / _ALIASES))

    def resolve(self, reference: str) -> tuple[str, str]:
        """The (name, version) that an alias, `name` or `name@version` points at.

        Raises:
            StoreError: see `resolve_reference`; `invalid_aliases`, or `unreadable`.
        """
        return resolve_reference(reference, self.aliases(), self.versions)

    def load(self, name: str, version: str, previous: Artifact | None = None) -> Artifact:
        """Load and verify one version.

        Args:
            name, version: as published.
            previous: see `load_artifact`.

        Raises:
            ArtifactError: it cannot be used; `wrong_place` where it is another one's copy.
            StoreError: `invalid_reference`, `unreadable`, or `unknown_version`.
        """
        if check_version(version) not in self.versions(name):
            raise StoreError("unknown_version", f"model '{name}' has no version {version}")
        folder = self.root / name / version
        artifact = load_artifact(folder, previous, self._max_weights_bytes)
        manifest = artifact.manifest
        if (manifest.name, manifest.version) != (name, version):
            raise ArtifactError(
                "wrong_place", f"this is {manifest.name}@{manifest.version}, not {name}@{version}"
            )
        return artifact

    def state(self) -> StoreState:
        """What changes whenever a version or an alias does; no file is read for it."""
        files = [self.root / _ALIASES]
        with suppress(StoreError):
            for name in self.names():
                for version in self.versions(name):
                    folder = self.root / name / version
                    files += [folder / file for file in (MANIFEST, WEIGHTS, CARD)]
        return tuple((str(file), *_appearance(file)) for file in files)

    # -- writing --------------------------------------------------------------------------------

    def publish(
        self,
        description: Description,
        state: Mapping[str, ArrayLike],
        *,
        storage_dtype: StorageDtype = "float32",
        alias: str | None = None,
    ) -> Artifact:
        """Make a version visible, once and for all, and point an alias at it.

        The artifact is written beside its place and loaded from there, so that nothing which the
        service would refuse is ever published; then it is renamed, then the alias is moved.

        Args:
            description, state, storage_dtype: see `write_artifact`.
            alias: afterwards points at this very version.

        Returns:
            The published artifact, as a reader loads it.

        Raises:
            ArtifactError: the artifact would be refused.
            StoreError: `version_exists`, `name_conflict`, `invalid_reference`, `invalid_aliases`,
                `unsafe_path`, `locked`, or `not_writable`.
        """
        name, version = description.name, description.version
        if alias is not None:
            check_name(alias, "alias")
        with self._writing():
            if name == alias or name in self.aliases():
                raise StoreError("name_conflict", f"'{name}' would be a model and an alias")
            if alias is not None:
                self._require_no_model(alias)
            folder = self._prepare_folder(name)
            place = folder / version
            if os.path.lexists(place):
                raise StoreError("version_exists", f"{name}@{version} is already published")
            temporary = folder / f"{_TEMPORARY}{version}-{token_hex(8)}"
            try:
                write_artifact(temporary, description, state, storage_dtype=storage_dtype)
                artifact = load_artifact(temporary, None, self._max_weights_bytes)
                rename(temporary, place)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
            if alias is not None:
                self._write_alias(alias, AliasTarget(name=name, version=version))
        return dataclasses.replace(artifact, path=place)

    def set_alias(
        self,
        alias: str,
        target: AliasTarget,
        *,
        expected: AliasTarget | Literal["any"] | None = "any",
    ) -> None:
        """Point an alias at a version, or at the latest.

        Args:
            alias: created where there is none.
            target: must exist.
            expected: what the alias must point at now (None: nothing) for the change to happen.

        Raises:
            StoreError: `alias_conflict` where it points elsewhere by now; `unknown_model`,
                `unknown_version`, `name_conflict`, `invalid_reference`, `invalid_aliases`,
                `locked`, or `not_writable`.
        """
        check_name(alias, "alias")
        with self._writing():
            self._require_no_model(alias)
            self._require_expected(alias, expected)
            resolve_reference(str(target), {}, self.versions)
            self._write_alias(alias, target)

    def remove_alias(self, alias: str, *, expected: AliasTarget | Literal["any"] = "any") -> None:
        """Forget an alias.

        Raises:
            StoreError: `unknown_model` where there is no such alias; else see `set_alias`.
        """
        check_name(alias, "alias")
        with self._writing():
            if alias not in self.aliases():
                raise StoreError("unknown_model", f"there is no alias named '{alias}'")
            self._require_expected(alias, expected)
            self._write_alias(alias, None)

    # -- inside ---------------------------------------------------------------------------------

    def _folders(self) -> list[str]:
        try:
            return sorted(entry.name for entry in self.root.iterdir() if is_name(entry.name))
        except OSError as error:
            raise StoreError("unreadable", f"the store: {cause(error)}") from None

    def _may_hold_versions(self, name: str) -> bool:
        try:
            return bool(self.versions(name))
        except StoreError:
            return True

    def _prepare_folder(self, name: str) -> Path:
        folder = self.root / name
        if os.path.lexists(folder) and not _is_directory(folder):
            raise StoreError("unsafe_path", f"model '{name}' is not a directory")
        make_directory(folder)
        return folder

    def _write_alias(self, alias: str, target: AliasTarget | None) -> None:
        table = {name: entry for name, entry in self.aliases().items() if name != alias}
        if target is not None:
            table[alias] = target
        write_aliases(self.root / _ALIASES, table, prefix=_TEMPORARY)

    def _require_no_model(self, alias: str) -> None:
        if self.versions(alias):
            raise StoreError("name_conflict", f"'{alias}' is the name of a model")

    def _require_expected(self, alias: str, expected: AliasTarget | Literal["any"] | None) -> None:
        current = self.aliases().get(alias)
        if expected not in ("any", current):
            raise StoreError(
                "alias_conflict",
                f"alias '{alias}' points at {current or 'nothing'}, not at {expected or 'nothing'}",
            )

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Exclude other writers, and clear away what dead ones left."""
        try:
            make_directory(self.root)
            with exclusive(self.root / _LOCK, self._lock_timeout):
                self._clear_leftovers()
                yield
        except OSError as error:
            raise StoreError("not_writable", f"the store: {cause(error)}") from error

    def _clear_leftovers(self) -> None:
        folders = [self.root, *(self.root / name for name in self._folders())]
        for folder in filter(_is_directory, folders):
            for entry in folder.iterdir():
                if not entry.name.startswith(_TEMPORARY):
                    continue
                if _is_directory(entry):
                    shutil.rmtree(entry)
                else:
                    entry.unlink()


def _appearance(path: Path) -> tuple[int, ...]:
    """Inode, size and time of the last change; () for a missing file."""
    try:
        status = path.lstat()
    except OSError:
        return ()
    return status.st_ino, status.st_size, status.st_mtime_ns


def _is_unfinished(version: Path) -> bool:
    """A folder that can be read and holds no manifest."""
    try:
        (version / MANIFEST).lstat()
    except FileNotFoundError:
        return _is_directory(version)
    except OSError:
        pass
    return False


def _is_directory(path: Path) -> bool:
    """A directory itself, not a link to one."""
    try:
        return stat.S_ISDIR(path.lstat().st_mode)
    except OSError:
        return False
