"""Artifacts: the files of one version of a model.

Every load reads each file once and checks it against its checksum. Symbolic links are not followed.
"""

import errno
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.inference import MachineSpec, Weights
from app.inference.objects import LARGEST_WEIGHT
from app.inference.weights import layout
from app.model import Counts, Offsets, Places, Possibility, SceneModel, derived_bytes
from app.registry.card import render_card
from app.registry.description import Description
from app.registry.durable import read_file, sync_directory, write_file
from app.registry.errors import ArtifactError, cause
from app.registry.manifest import CARD, GROUPS, MANIFEST, WEIGHTS, FileEntry, Manifest
from app.registry.tensors import StorageDtype, pack, read_group, require_equal, unpack
from scene_client.schemas import ModelReference

MAX_MANIFEST_BYTES: Final = 4 * 2**20
"""Maximum size of a manifest in bytes. A manifest of 785 classes has 162 kB."""
MAX_CARD_BYTES: Final = 2**20
MAX_WEIGHTS_BYTES: Final = 2**30
"""Default maximum size of the weights file in bytes."""
MAX_DERIVED_BYTES: Final = 2**29
"""Maximum of `derived_bytes`. A shipped model of 1,582 classes has 210 MB."""

_DTYPES: Final = {float: "float32", int: "int32"}


@dataclass(frozen=True, eq=False)
class Artifact:
    """The verified files of one version of a model, and the model that they contain."""

    manifest: Manifest
    model: SceneModel
    digest: str  # SHA-256 of the manifest in hexadecimal; it depends on all files
    card: str  # Markdown
    path: Path  # directory

    @cached_property
    def key(self) -> tuple[str, str]:
        """Name and version of the model."""
        return self.manifest.name, self.manifest.version

    @cached_property
    def reference(self) -> ModelReference:
        """The field `model` of answers."""
        name, version = self.key
        return ModelReference(
            name=name, version=version, variant=self.manifest.variant, digest=self.digest
        )


def write_artifact(
    directory: Path,
    description: Description,
    state: Mapping[str, ArrayLike],
    *,
    storage_dtype: StorageDtype = "float32",
) -> Manifest:
    """Write an artifact into a new directory, whose parent exists, and sync it to disk.

    ``state`` has the arrays of `layout`, and optionally the tables of a `SceneModel`; see
    `pack` for ``storage_dtype``.

    Raises:
        ArtifactError: the artifact format cannot store a tensor; see `pack`.
        OSError: the operating system could not write a file.
    """
    weights, tensors = pack(state, storage_dtype)
    card = render_card(description, tensors).encode()
    manifest = Manifest(
        **dict(description),
        tensors=tensors,
        files={
            name: FileEntry(sha256=_digest(data), bytes=len(data))
            for name, data in ((WEIGHTS, weights), (CARD, card))
        },
    )
    _write_files(directory, weights, card, manifest.to_bytes())
    return manifest


def copy_artifact(artifact: Artifact, directory: Path) -> None:
    """Copy the files of a loaded artifact into a new directory, and sync it to disk.

    Raises:
        ArtifactError: a file is invalid.
        OSError: the operating system could not write a file.
    """
    size = artifact.manifest.files[WEIGHTS].bytes
    _, text, weights, card = _read_verified(artifact.path, size)
    _write_files(directory, weights, card.encode(), text)


def _write_files(directory: Path, weights: bytes, card: bytes, manifest: bytes) -> None:
    directory.mkdir(mode=0o755)
    for name, data in ((WEIGHTS, weights), (CARD, card), (MANIFEST, manifest)):
        write_file(directory / name, data)
    sync_directory(directory)


def load_artifact(
    directory: Path, previous: Artifact | None = None, max_weights_bytes: int = MAX_WEIGHTS_BYTES
) -> Artifact:
    """Read and verify an artifact. Return ``previous`` if its digest is unchanged.

    Raises:
        ArtifactError: the artifact is invalid. The exception describes the first error found.
    """
    manifest, text, stored, card = _read_verified(directory, max_weights_bytes)
    digest = _digest(text)
    if previous is not None and previous.digest == digest:
        return previous
    model = _model(manifest, unpack(stored, manifest.tensors))
    return Artifact(manifest, model, digest, card, directory)


def _model(manifest: Manifest, tensors: dict[str, NDArray[Any]]) -> SceneModel:
    """Return the model of the tensors by name: its weights and its tables of statistics."""
    tables = [
        {name: tensors.pop(name) for name in list(tensors) if name.startswith(group.prefix)}
        for group in GROUPS
    ]
    weights = _weights(manifest, tensors)
    sizes = weights.spec.A, weights.spec.V, len(manifest.vocabulary.room_types)
    return SceneModel(
        weights,
        manifest.vocabulary.vocabulary(),
        manifest.calibration,
        read_group(Offsets, tables[0], *sizes),
        read_group(Counts, tables[1], *sizes),
        read_group(Places, tables[2], *sizes),
        read_group(Possibility, tables[3], *sizes),
    )


def manifest_digest(directory: Path) -> str | None:
    """Return the digest of an artifact of any format, or None if its manifest cannot be read."""
    try:
        return _digest(read_file(directory / MANIFEST, MAX_MANIFEST_BYTES))
    except OSError:
        return None


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _weights(manifest: Manifest, tensors: Mapping[str, NDArray[Any]]) -> Weights:
    """Return the weights of a machine, or raise ArtifactError if they do not fit the spec."""
    try:
        spec = MachineSpec.from_dict(dict(manifest.spec))
        expected = layout(spec)
    except (ValueError, TypeError) as error:
        reason = f"the manifest has an invalid spec: {error}"
        raise ArtifactError("invalid_manifest", reason) from None
    require_equal(
        {name: (array.dtype.name, array.shape) for name, array in tensors.items()},
        {name: (_DTYPES[kind], shape) for name, (kind, shape) in expected.items()},
        "the artifact has",
        f"but a {spec.variant} machine of this spec needs",
    )
    if (derived := derived_bytes(spec)) > MAX_DERIVED_BYTES:
        most = f"more than the maximum of {MAX_DERIVED_BYTES} bytes"
        reason = f"answers of a machine of these sizes need arrays of {derived} bytes, {most}"
        raise ArtifactError("too_large", reason)
    try:
        weights = Weights(spec, tensors)
    except ValueError as error:
        raise ArtifactError("invalid_tensor", str(error)) from None
    if spec.coupled and (weights["L"].diagonal().any() or (weights["L"] != weights["L"].T).any()):
        raise ArtifactError("invalid_tensor", "L must be symmetric with a diagonal of 0")
    largest = max(np.abs(weights[name]).max(initial=0) for name in ("W", "Q"))
    if not largest <= LARGEST_WEIGHT:
        limits = f"-{LARGEST_WEIGHT:g} and {LARGEST_WEIGHT:g}"
        reason = "the service does not support this machine: its weights W and Q must be between "
        raise ArtifactError("unsupported", reason + limits)
    return weights


def _read_verified(directory: Path, max_weights_bytes: int) -> tuple[Manifest, bytes, bytes, str]:
    """Return the verified manifest, its bytes, the bytes of the weights and the model card."""
    try:
        if directory.is_symlink():
            raise OSError(errno.ELOOP, "")
        extra = {entry.name for entry in directory.iterdir()} - {MANIFEST, WEIGHTS, CARD}
    except FileNotFoundError:
        raise ArtifactError("missing_file", "the artifact's directory does not exist") from None
    except OSError as error:
        raise _unreadable("the artifact's directory", error) from None
    if extra:
        names = ", ".join(sorted(ascii(name) for name in extra)[:8])
        reason = f"the artifact's directory has unexpected files: {names}"
        raise ArtifactError("unexpected_file", reason)
    text = _read(directory / MANIFEST, MAX_MANIFEST_BYTES)
    _require_size(MANIFEST, len(text), MAX_MANIFEST_BYTES)
    manifest = Manifest.from_bytes(text)
    weights = _read_checked(directory / WEIGHTS, manifest, max_weights_bytes)
    card = _read_checked(directory / CARD, manifest, MAX_CARD_BYTES)
    return manifest, text, weights, card.decode(errors="replace")


def _require_size(name: str, size: int, limit: int) -> None:
    if size > limit:
        raise ArtifactError("too_large", f"{name} has more than the maximum of {limit} bytes")


def _read(path: Path, limit: int) -> bytes:
    """Return at most ``limit`` + 1 bytes of a file, or raise ArtifactError if it is unreadable."""
    try:
        return read_file(path, limit)
    except FileNotFoundError:
        raise ArtifactError("missing_file", f"the artifact has no file {path.name}") from None
    except OSError as error:
        raise _unreadable(path.name, error) from None


def _unreadable(what: str, error: OSError) -> ArtifactError:
    return ArtifactError("unreadable", f"{what} cannot be read: {cause(error)}")


def _read_checked(path: Path, manifest: Manifest, limit: int) -> bytes:
    """Return a file whose size and SHA-256 are those of the manifest, or raise ArtifactError."""
    name, entry = path.name, manifest.files[path.name]
    _require_size(name, entry.bytes, limit)
    data = _read(path, entry.bytes)
    if len(data) < entry.bytes:
        raise ArtifactError("truncated", f"{name} has only {len(data)} of {entry.bytes} bytes")
    if _digest(data) != entry.sha256:
        reason = f"{name} does not match its checksum: the file was altered"
        raise ArtifactError("checksum_mismatch", reason)
    return data
