"""A store in object storage (S3, Google Cloud Storage, Azure), served from a verified local copy.

    <url>/index.json                                                      see `app.registry.index`
    <url>/<name>/<version>/{model.safetensors, card.md, manifest.json}

A publisher uploads the files of a version and writes the index last. It replaces the index only if
no other publisher has replaced it in the meantime (If-Match). So publishers cannot lose each
other's changes. A replica reads the index regularly, downloads new versions into the copy, and
checks them against the digests in the index. The copy is an ordinary store in a folder.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import obstore
from numpy.typing import ArrayLike
from obstore.exceptions import AlreadyExistsError, BaseError, NotModifiedError, PreconditionError
from obstore.store import from_url

from app.registry.aliases import write_aliases
from app.registry.artifact import Artifact
from app.registry.description import Description
from app.registry.durable import make_directory, rename, replace_file
from app.registry.errors import ArtifactError, StoreError, cause
from app.registry.index import MAX_INDEX_BYTES, Index, Signer, read_index, versions_of, write_index
from app.registry.location import MAX_CACHE_BYTES
from app.registry.manifest import CARD, MANIFEST, WEIGHTS, Manifest
from app.registry.references import AliasTarget, check_name, resolve_reference, version_key
from app.registry.store import ALIASES, TEMPORARY, Store, StoreState
from app.registry.tensors import StorageDtype
from app.registry.verified import (
    MAX_CARD_BYTES,
    MAX_MANIFEST_BYTES,
    MAX_WEIGHTS_BYTES,
    read_verified,
)

if TYPE_CHECKING:
    from obstore import GetOptions, UpdateVersion
    from obstore.store import ObjectStore

INDEX: Final = "index.json"
# Size in bytes of one request of a download.
_PIECE: Final = 4 * 2**20
# Time in seconds after which a replica tries again to download a version.
_RETRY: Final = 60.0
# Errors of files that were valid after their download: the local disk has changed them.
_DAMAGED: Final = {"checksum_mismatch", "truncated", "missing_file", "unexpected_file"}
# Number of times that a publisher tries to replace the index while others replace it, too.
_ATTEMPTS: Final = 20

_logger = logging.getLogger("app.registry")


def connect(url: str, timeout: float = 10.0) -> ObjectStore:
    """Return the object storage of a URL.

    Credentials and endpoints come from the environment, by the rules of the Rust crate
    object_store: AWS_*, GOOGLE_* or AZURE_* variables, or the identity of the machine.

    Args:
        url: s3://bucket/prefix, gs://bucket/prefix or az://container/prefix.
        timeout: maximum time in seconds of one HTTP request, and of all retries of a request.

    Raises:
        StoreError: `unreachable` if the environment lacks a required value.
    """
    plain = any(os.environ.get(f"{cloud}_ALLOW_HTTP") for cloud in ("AWS", "AZURE"))
    limit = timedelta(seconds=timeout)
    try:
        return from_url(
            url,
            client_options={"timeout": limit, "connect_timeout": limit / 2, "allow_http": plain},
            retry_config={"max_retries": 2, "retry_timeout": limit},
        )
    except BaseError as error:
        raise _unreachable(error) from None


class RemoteStore(Store):
    """A store in object storage.

    All reading methods read the local copy. `sync` brings the copy up to date.

    Args:
        bucket: the object storage; see `connect`.
        cache: folder of the local copy. Only the service may have access to it.
        trusted: public keys in base64; see `read_index`. None accepts an unsigned index.
        signer: private key of a publisher. None signs nothing.
        max_weights_bytes: maximum size of a version's weights file.
        max_cache_bytes: maximum size of all versions in the copy.
    """

    def __init__(
        self,
        bucket: ObjectStore,
        cache: Path,
        *,
        trusted: Collection[str] | None,
        signer: Signer | None = None,
        max_weights_bytes: int = MAX_WEIGHTS_BYTES,
        max_cache_bytes: int = MAX_CACHE_BYTES,
    ) -> None:
        super().__init__(cache / "store", max_weights_bytes=max_weights_bytes)
        # Time of the last successful `sync` in seconds since 1970. The index in the copy keeps it.
        self._synced = time.time()
        self._bucket, self._cache = bucket, cache
        self._trusted, self._signer = trusted, signer
        self._max_cache_bytes = max_cache_bytes
        self._index = Index()
        self._e_tag: str | None = None
        self._refused: dict[tuple[str, str], ArtifactError] = {}
        self._retry_at = 0.0
        self._syncing = threading.Lock()

    # -- the local copy -------------------------------------------------------------------------

    def sync(self) -> None:
        """Bring the local copy up to date with the remote store.

        If the index cannot be read or is not acceptable, the copy stays unchanged and `error` has
        the reason. If one version cannot be downloaded, `load` raises the reason for this version.
        A later call tries again.
        """
        with self._syncing:
            try:
                self._prepare_cache()
                if (found := self._fetch_index()) is not None:
                    self._accept(*found)
                self._download_missing()
                os.utime(self._cache / INDEX)
            except StoreError as error:
                if str(error) != str(self.error):
                    _logger.error("%s", error)
                self.error = error
            else:
                if self.error is not None:
                    _logger.info("the remote store can be read again")
                self.error, self._synced = None, time.time()

    @property
    def age(self) -> float:
        """Seconds since the last successful `sync`, or since the start if there was none."""
        return max(0.0, time.time() - self._synced)

    def versions(self, name: str) -> tuple[str, ...]:
        """Return the versions of a model in the index, ascending. See `Store.versions`."""
        check_name(name)
        return tuple(sorted(versions_of(self._index.versions, name), key=version_key))

    def load(self, name: str, version: str, previous: Artifact | None = None) -> Artifact:
        """Load a version from the local copy. See `Store.load`.

        Raises:
            ArtifactError: also `revoked`, or the reason why the version could not be downloaded.
        """
        if (refused := self._refused.get((name, version))) is not None:
            raise refused
        try:
            artifact = super().load(name, version, previous)
        except ArtifactError as error:
            if error.code in _DAMAGED:  # the next `sync` downloads the version again
                shutil.rmtree(self.root / name / version, ignore_errors=True)
            raise
        if artifact.digest != self._index.versions.get(f"{name}@{version}"):
            shutil.rmtree(self.root / name / version, ignore_errors=True)
            raise ArtifactError("checksum_mismatch", f"{MANIFEST} does not match the index")
        return artifact

    def state(self) -> StoreState:
        """Return a value that changes when the index or the outcome of a download changes."""
        refused = sorted((*key, error.code) for key, error in self._refused.items())
        return (("counter", self._index.counter), *refused, *super().state())

    def _folders(self) -> list[str]:
        return sorted({reference.partition("@")[0] for reference in self._index.versions})

    def _prepare_cache(self) -> None:
        """Create the folder of the copy, and read its index after a restart."""
        try:
            make_directory(self._cache.parent)
            self._cache.mkdir(mode=0o700, exist_ok=True)
            self._cache.chmod(0o700)
            make_directory(self.root)
            known = self._cache / INDEX
            if not known.exists():  # a new copy, or the copy was deleted
                self._e_tag = None
            elif not self._index.counter:
                with suppress(StoreError):  # the copy is from another store, or a key was removed
                    self._use(read_index(known.read_bytes(), self._trusted))
                    self._synced = known.stat().st_mtime
        except OSError as error:
            raise StoreError("not_writable", f"the copy of the store: {cause(error)}") from None

    def _fetch_index(self) -> tuple[Index, bytes, str | None] | None:
        """Return the new index, its bytes and its ETag, or None if it is unchanged.

        Raises:
            StoreError: `empty`, `unreachable`, `untrusted_index`, `invalid_index`, or `rolled_back`
                if the index is older than the known index.
        """
        try:
            known: GetOptions = {} if self._e_tag is None else {"if_none_match": self._e_tag}
            found = obstore.get(self._bucket, INDEX, options=known)
            _require_size(INDEX, found.meta["size"], MAX_INDEX_BYTES)
            data = bytes(found.bytes())
        except NotModifiedError:
            return None
        except FileNotFoundError:
            raise StoreError("empty", f"the remote store has no {INDEX}") from None
        except (BaseError, OSError) as error:
            raise _unreachable(error) from None
        except ArtifactError as error:
            raise StoreError("invalid_index", error.reason) from None
        index = read_index(data, self._trusted)
        if index.counter < self._index.counter:
            raise StoreError(
                "rolled_back",
                f"the index has the counter {index.counter}, but this replica has seen "
                f"{self._index.counter}",
            )
        return index, data, found.meta["e_tag"]

    def _accept(self, index: Index, data: bytes, e_tag: str | None) -> None:
        """Make an index the current one.

        Raises:
            StoreError: `not_writable`.
        """
        try:
            with self._writing():
                replace_file(self._cache / INDEX, data, prefix=TEMPORARY)
                write_aliases(self.root / ALIASES, index.aliases, prefix=TEMPORARY)
        except OSError as error:
            raise StoreError("not_writable", f"the copy of the store: {cause(error)}") from None
        self._e_tag = e_tag
        self._use(index)
        kept = index.versions.keys() - index.revoked.keys()
        for folder in self.root.glob("*/*"):
            if f"{folder.parent.name}@{folder.name}" not in kept:
                shutil.rmtree(folder, ignore_errors=True)

    def _use(self, index: Index) -> None:
        self._index, self._retry_at = index, 0.0
        self._refused = {
            (name, version): ArtifactError("revoked", f"the publisher revoked it: {reason}")
            for reference, reason in index.revoked.items()
            for name, version in [reference.split("@")]
        }

    def _download_missing(self) -> None:
        retry, now = time.monotonic() >= self._retry_at, time.monotonic()
        for reference, digest in self._index.versions.items():
            name, version = key = reference.split("@")[0], reference.split("@")[1]
            folder = self.root / name / version
            known_error = key in self._refused and not retry
            if reference in self._index.revoked or folder.exists() or known_error:
                continue
            try:
                self._download(folder, f"{name}/{version}", digest)
            except ArtifactError as error:
                self._refused[key], self._retry_at = error, now + _RETRY
                _logger.error("%s cannot be downloaded: %s", reference, error)
            except OSError as error:
                raise StoreError("not_writable", f"the copy: {cause(error)}") from None
            else:
                self._refused.pop(key, None)
                _logger.info("%s is downloaded", reference)

    def _download(self, folder: Path, path: str, digest: str) -> None:
        make_directory(folder.parent)
        temporary = Path(tempfile.mkdtemp(prefix=TEMPORARY, dir=folder.parent))
        try:
            text = self._fetch(path, MANIFEST, MAX_MANIFEST_BYTES, temporary)
            if hashlib.sha256(text).hexdigest() != digest:
                raise ArtifactError("checksum_mismatch", f"{MANIFEST} does not match the index")
            files = Manifest.from_bytes(text).files
            if sum(entry.bytes for entry in files.values()) > self._max_cache_bytes - self._used():
                raise ArtifactError("too_large", "the local copy has reached its maximum size")
            for name, limit in ((WEIGHTS, self._max_weights_bytes), (CARD, MAX_CARD_BYTES)):
                self._fetch(path, name, min(limit, files[name].bytes), temporary)
            read_verified(temporary, self._max_weights_bytes)
            temporary.chmod(0o755)
            rename(temporary, folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)

    def _fetch(self, path: str, name: str, limit: int, folder: Path) -> bytes:
        """Download a file of at most `limit` bytes into a folder. Return a manifest's bytes."""
        place = f"{path}/{name}"
        try:
            size = obstore.head(self._bucket, place)["size"]
            _require_size(name, size, limit)
            with (folder / name).open("wb") as file:
                # Each piece is a request of its own, so that the time-out does not limit the size.
                for start in range(0, size, _PIECE):
                    end = min(start + _PIECE, size)
                    file.write(obstore.get_range(self._bucket, place, start=start, end=end))
        except FileNotFoundError:
            raise ArtifactError("missing_file", f"{name} is missing in the remote store") from None
        except BaseError as error:
            raise ArtifactError("unreadable", f"{name}: {_unreachable(error).reason}") from None
        return (folder / name).read_bytes() if name == MANIFEST else b""

    def _used(self) -> int:
        return sum(file.stat().st_size for file in self.root.glob("*/*/*"))

    # -- publishing -----------------------------------------------------------------------------

    def publish(
        self,
        description: Description,
        state: Mapping[str, ArrayLike],
        *,
        storage_dtype: StorageDtype = "float32",
        alias: str | None = None,
    ) -> Artifact:
        """Publish a version in the remote store. See `Store.publish`.

        Raises:
            StoreError: also `unreachable`.
        """
        with tempfile.TemporaryDirectory() as scratch:
            local = Store(scratch, max_weights_bytes=self._max_weights_bytes)
            artifact = local.publish(description, state, storage_dtype=storage_dtype)
            self.upload(artifact, alias)
        self.sync()
        return self.load(description.name, description.version)

    def upload(self, artifact: Artifact, alias: str | None = None) -> None:
        """Copy a version from another store, and optionally point an alias at it.

        Raises:
            StoreError: see `publish`.
        """
        name, version = artifact.manifest.name, artifact.manifest.version
        reference = f"{name}@{version}"
        if alias is not None:
            check_name(alias, "alias")

        def change(index: Index) -> Index:
            if reference in index.versions:
                raise StoreError("version_exists", f"{reference} is already published")
            aliases = dict(index.aliases)
            if alias is not None:
                aliases[alias] = AliasTarget(name=name, version=version)
            versions = dict(index.versions) | {reference: artifact.digest}
            return index.changed(versions=versions, aliases=aliases)

        self._require_key()
        change(self._read()[0])
        for file in (WEIGHTS, CARD, MANIFEST):
            self._put_new(f"{name}/{version}/{file}", (artifact.path / file).read_bytes())
        self._change(change)

    def set_alias(
        self,
        alias: str,
        target: AliasTarget,
        *,
        expected: AliasTarget | Literal["any"] | None = "any",
    ) -> None:
        """Point an alias at a version in the remote store. See `Store.set_alias`."""
        check_name(alias, "alias")

        def change(index: Index) -> Index:
            _require_expected(index, alias, expected)
            resolve_reference(str(target), {}, lambda name: _usable(index, name))
            return index.changed(aliases=dict(index.aliases) | {alias: target})

        self._change(change)

    def remove_alias(self, alias: str, *, expected: AliasTarget | Literal["any"] = "any") -> None:
        """Remove an alias from the remote store. See `Store.remove_alias`."""
        check_name(alias, "alias")

        def change(index: Index) -> Index:
            if alias not in index.aliases:
                raise StoreError("unknown_model", f"no alias has the name '{alias}'")
            _require_expected(index, alias, expected)
            kept = {name: target for name, target in index.aliases.items() if name != alias}
            return index.changed(aliases=kept)

        self._change(change)

    def revoke(self, name: str, version: str, reason: str) -> None:
        """Forbid replicas to serve a version.

        Raises:
            StoreError: `unknown_version`, or `alias_conflict` if an alias points at the version.
        """
        reference = f"{name}@{version}"

        def change(index: Index) -> Index:
            if reference not in index.versions:
                raise StoreError("unknown_version", f"the store does not contain {reference}")
            for alias, target in index.aliases.items():
                if target.name == name and (target.version or _usable(index, name)[-1]) == version:
                    raise StoreError(
                        "alias_conflict", f"alias '{alias}' points at {reference}; move it first"
                    )
            return index.changed(revoked=dict(index.revoked) | {reference: reason})

        self._change(change)

    def _read(self) -> tuple[Index, str | None]:
        """Return the remote index and its ETag. A new store has an empty index without ETag.

        Raises:
            StoreError: `unreachable`, `untrusted_index`, `invalid_index`, or `rolled_back`.
        """
        self._e_tag = None
        try:
            found = self._fetch_index()
        except StoreError as error:
            if error.code == "empty":
                return Index(), None
            raise
        if found is None:
            raise StoreError("unreachable", "the storage answered 304 to a request without an ETag")
        return found[0], found[2]

    def _change(self, change: Callable[[Index], Index]) -> None:
        """Replace the remote index, unless another publisher replaces it at the same time.

        Args:
            change: function from the current index to the new index. After a conflict, it gets the
                index of the other publisher.

        Raises:
            StoreError: `not_writable`, `unreachable`, or `locked` after too many conflicts; and
                the errors of `change`.
        """
        self._require_key()
        for attempt in range(_ATTEMPTS):
            index, e_tag = self._read()
            data = write_index(change(index), self._signer)
            mode: Literal["create"] | UpdateVersion
            mode = "create" if e_tag is None else {"e_tag": e_tag}
            try:
                obstore.put(self._bucket, INDEX, data, mode=mode)
            except (AlreadyExistsError, PreconditionError):
                time.sleep(0.02 * attempt)
            except (BaseError, OSError) as error:
                raise _unreachable(error) from None
            else:
                return
        raise StoreError("locked", "other publishers changed the index at the same time; try again")

    def _require_key(self) -> None:
        if self._trusted is not None and self._signer is None:
            raise StoreError(
                "not_writable",
                "changes of a remote store need a signing key (SCENE_SIGNING_KEY); "
                "`python -m app.registry alias` moves an alias",
            )

    def _put_new(self, path: str, data: bytes) -> None:
        """Upload a new object. An object of the same contents is left unchanged.

        Raises:
            StoreError: `version_exists` if the object has other contents, or `unreachable`.
        """
        try:
            obstore.put(self._bucket, path, data, mode="create")
        except AlreadyExistsError:
            # An earlier publication stopped before it wrote the index.
            known = obstore.get(self._bucket, path)
            if known.meta["size"] != len(data) or bytes(known.bytes()) != data:
                raise StoreError(
                    "version_exists",
                    f"the remote store has another {path}; publish another version number",
                ) from None
        except (BaseError, OSError) as error:
            raise _unreachable(error) from None


def _usable(index: Index, name: str) -> list[str]:
    """Return the versions of a model that are not revoked, ascending."""
    return sorted(versions_of(index.versions.keys() - index.revoked.keys(), name), key=version_key)


def _require_expected(
    index: Index, alias: str, expected: AliasTarget | Literal["any"] | None
) -> None:
    if index.aliases.get(alias) != expected != "any":
        raise StoreError(
            "alias_conflict",
            f"alias '{alias}' points at {index.aliases.get(alias) or 'nothing'}, "
            f"not at {expected or 'nothing'}",
        )


def _require_size(name: str, size: int, limit: int) -> None:
    if size > limit:
        raise ArtifactError("too_large", f"{name} has {size} bytes, the limit is {limit}")


def _unreachable(error: Exception) -> StoreError:
    """Return an error with the first line of the library's message, without a URL's query."""
    first = re.sub(r"\?\S*", "", str(error).partition("\n")[0])[:300]
    return StoreError("unreachable", f"the remote store cannot be reached: {first}")
