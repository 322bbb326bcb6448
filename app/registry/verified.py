"""Reading the files of an artifact: each file is read once and checked against its checksum.

Later steps parse the bytes that this module has hashed. So a change of a file after the check has
no effect. The module does not follow symbolic links.
"""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from app.registry.errors import ArtifactError, cause
from app.registry.manifest import CARD, MANIFEST, WEIGHTS, FileEntry, Manifest

MAX_MANIFEST_BYTES: Final = 4 * 2**20
"""Maximum size of a manifest in bytes. A manifest of 785 classes has 162 kB."""
MAX_CARD_BYTES: Final = 2**20
MAX_WEIGHTS_BYTES: Final = 2**30
"""Default maximum size of the weights file in bytes. The environment variable
SCENE_MAX_WEIGHTS_BYTES sets another maximum."""


@dataclass(frozen=True, slots=True)
class VerifiedFiles:
    """The contents of an artifact's files, verified by their checksums.

    Attributes:
        manifest: the parsed manifest.
        digest: SHA-256 of the manifest's bytes as a hexadecimal string. The digest identifies all
            files, because the manifest contains their checksums.
        weights: bytes of the safetensors file.
        card: the model card in Markdown.
    """

    manifest: Manifest
    digest: str
    weights: bytes
    card: str


def read_verified(directory: Path, max_weights_bytes: int = MAX_WEIGHTS_BYTES) -> VerifiedFiles:
    """Read and verify the files of an artifact.

    Args:
        directory: directory of the artifact.
        max_weights_bytes: maximum size of the weights file. The function checks the size before it
            reads the file.

    Raises:
        ArtifactError: a file is missing, unexpected, unreadable, too large, truncated or altered,
            or this release cannot read the manifest.
    """
    try:
        folder = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except FileNotFoundError:
        raise ArtifactError("missing_file", "the artifact's directory does not exist") from None
    except OSError as error:
        raise ArtifactError(
            "unreadable", f"the artifact's directory cannot be read: {cause(error)}"
        ) from None
    try:
        _require_no_other_file(folder)
        text = _read(folder, MANIFEST, MAX_MANIFEST_BYTES)
        _require_size(MANIFEST, len(text), MAX_MANIFEST_BYTES)
        manifest = Manifest.from_bytes(text)
        weights = _read_checked(folder, WEIGHTS, manifest.files[WEIGHTS], max_weights_bytes)
        card = _read_checked(folder, CARD, manifest.files[CARD], MAX_CARD_BYTES)
    finally:
        os.close(folder)
    try:
        page = card.decode()
    except UnicodeDecodeError:
        raise ArtifactError("invalid_manifest", f"{CARD} is not UTF-8") from None
    return VerifiedFiles(manifest, hashlib.sha256(text).hexdigest(), weights, page)


def _require_no_other_file(folder: int) -> None:
    try:
        with os.scandir(folder) as entries:
            extra = {entry.name for entry in entries} - {MANIFEST, WEIGHTS, CARD}
    except OSError as error:
        raise ArtifactError(
            "unreadable", f"the artifact's directory cannot be read: {cause(error)}"
        ) from None
    if extra:
        names = ", ".join(sorted(ascii(name) for name in extra))
        raise ArtifactError(
            "unexpected_file", f"the artifact's directory has unexpected files: {names}"
        )


def _require_size(name: str, size: int, limit: int) -> None:
    if size > limit:
        raise ArtifactError("too_large", f"{name} has more than the maximum of {limit} bytes")


def _read(folder: int, name: str, limit: int) -> bytes:
    """Read at most limit + 1 bytes of a file. The extra byte shows that the file is too long."""
    # Without O_NONBLOCK, opening a FIFO in place of the file would block forever.
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(name, flags, dir_fd=folder)
    except FileNotFoundError:
        raise ArtifactError("missing_file", f"the artifact has no file {name}") from None
    except OSError as error:
        raise ArtifactError("unreadable", f"{name} cannot be read: {cause(error)}") from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise ArtifactError("unreadable", f"{name} is not a regular file")
        with os.fdopen(descriptor, "rb", closefd=False) as file:
            # read() first allocates a buffer for all requested bytes. The argument is at most the
            # size of the file plus 1, so that the buffer is not larger than needed.
            return file.read(min(status.st_size, limit) + 1)
    except OSError as error:
        raise ArtifactError("unreadable", f"{name} cannot be read: {cause(error)}") from None
    finally:
        os.close(descriptor)


def _read_checked(folder: int, name: str, entry: FileEntry, limit: int) -> bytes:
    _require_size(name, entry.bytes, limit)
    data = _read(folder, name, entry.bytes)
    if len(data) < entry.bytes:
        raise ArtifactError("truncated", f"{name} has only {len(data)} of {entry.bytes} bytes")
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise ArtifactError(
            "checksum_mismatch", f"{name} does not match its checksum: the file was altered"
        )
    return data
