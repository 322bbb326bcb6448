"""The location of a store: a folder, or a URL of object storage."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import Final

from app.registry.errors import StoreError
from app.registry.store import Store
from app.registry.verified import MAX_WEIGHTS_BYTES

MAX_CACHE_BYTES: Final = 8 * 2**30
"""Default maximum size in bytes of the local copy of a remote store."""

_URL: Final = re.compile(r"(?:s3|gs|az)://[A-Za-z0-9][A-Za-z0-9._-]{1,62}(?:/[A-Za-z0-9._-]+)*/?")


def is_url(location: str) -> bool:
    """Return whether a location is a URL of object storage: s3://, gs:// or az://."""
    return _URL.fullmatch(location) is not None


def default_cache(url: str) -> Path:
    """Return the default folder for the local copy of a remote store."""
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "scene-boltzmann" / hashlib.sha256(url.encode()).hexdigest()[:16]


def open_store(
    location: str | Path,
    *,
    trusted: Collection[str] | None = (),
    signing_key: Path | None = None,
    cache: Path | None = None,
    lock_timeout: float = 60.0,
    max_weights_bytes: int = MAX_WEIGHTS_BYTES,
    max_cache_bytes: int = MAX_CACHE_BYTES,
) -> Store:
    """Return the store at a location. The function does not read it.

    Args:
        location: a folder, or a URL; see `is_url`.
        trusted: for a URL, the public keys that may sign the index, in base64. None accepts an
            index without a signature.
        signing_key: for a URL, the PEM file of a publisher's private key. Its public key is trusted
            too.
        cache: for a URL, the folder of the local copy.
        lock_timeout: for a folder, see `Store`.
        max_weights_bytes: maximum size of a version's weights file.
        max_cache_bytes: for a URL, maximum size of the local copy in bytes.

    Raises:
        StoreError: `invalid_reference`, `invalid_key`, or `unreachable`.
    """
    text = str(location)
    if "://" not in text:
        return Store(text, lock_timeout=lock_timeout, max_weights_bytes=max_weights_bytes)
    if not is_url(text):
        raise StoreError(
            "invalid_reference",
            "the URL of a store must start with s3://, gs:// or az:// and contain only letters, "
            "digits and . _ - /",
        )
    # A service with a folder store does not need these libraries.
    from app.registry.index import Signer, public_key
    from app.registry.remote import RemoteStore, connect

    for key in trusted or ():
        public_key(key)
    signer = None if signing_key is None else Signer.read(signing_key)
    if trusted is not None and signer is not None:
        trusted = {*trusted, signer.public}
    return RemoteStore(
        connect(text),
        cache or default_cache(text),
        trusted=trusted,
        signer=signer,
        max_weights_bytes=max_weights_bytes,
        max_cache_bytes=max_cache_bytes,
    )


def open_for_publisher(location: str | Path) -> Store:
    """Return the store at a location, up to date, with the keys of the environment.

    SCENE_SIGNING_KEY is the PEM file of the private key, and SCENE_TRUSTED_KEYS lists public keys.
    Without a key, SCENE_UNSIGNED_STORE=true accepts a store without signatures.

    Raises:
        StoreError: see `open_store`, or the remote store has an index that cannot be used.
    """
    key = os.environ.get("SCENE_SIGNING_KEY")
    trusted = os.environ.get("SCENE_TRUSTED_KEYS", "").replace(",", " ").split()
    unsigned = os.environ.get("SCENE_UNSIGNED_STORE", "").lower() in {"1", "true", "yes", "on"}
    store = open_store(
        location,
        trusted=None if unsigned else trusted,
        signing_key=Path(key) if key else None,
    )
    store.sync()
    if store.error is not None and store.error.code != "empty":
        raise store.error
    return store
