"""Artifacts: the files of one version of a model, and the loaded model.

Every load reads each file once and checks it against its checksum. Symbolic links are not followed.
"""

import errno
import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.inference import MachineSpec, Weights
from app.inference.chains import SceneChains
from app.inference.objects import LARGEST_WEIGHT, ObjectScorer
from app.inference.relation_units import RelationUnits, StandIns, relation_units
from app.inference.weights import layout
from app.registry.card import render_card
from app.registry.counts import Counts
from app.registry.description import Calibration, Description, RelationSlopes
from app.registry.durable import read_file, sync_directory, write_file
from app.registry.errors import ArtifactError, cause
from app.registry.manifest import CARD, MANIFEST, WEIGHTS, FileEntry, Manifest
from app.registry.meaning import RowMap
from app.registry.offsets import Offsets
from app.registry.places import Places
from app.registry.tensors import StorageDtype, pack, require_equal, unpack
from app.scene.vocabulary import Vocabulary, Word
from scene_client.schemas import ModelReference

MAX_MANIFEST_BYTES: Final = 4 * 2**20
"""Maximum size of a manifest in bytes. A manifest of 785 classes has 162 kB."""
MAX_CARD_BYTES: Final = 2**20
MAX_WEIGHTS_BYTES: Final = 2**30
"""Default maximum size of the weights file in bytes."""

_MOST_KEPT: Final = 4  # models with words that a model keeps, of about 20 MB each

RARELY: Final = 1 / 500
"""A class is rarely shown if a smaller share of the training scenes shows it."""

_DTYPES: Final = {float: "float32", int: "int32"}


@dataclass(frozen=True, eq=False)
class Artifact:
    """A verified model, ready to answer questions.

    Attributes:
        manifest: description of the model and its files.
        weights: weights of the machine.
        vocabulary: names of the model's V object classes and C room types.
        calibration: conversion of log-odds into probabilities.
        digest: SHA-256 of the manifest in hexadecimal. It depends on all files of the artifact.
        card: model card in Markdown.
        path: directory of the artifact.
        offsets: vectors in metres between the centres of related objects; None without poses in the
            training scenes.
        counts: statistics of the numbers of instances; None without such numbers.
        places: counts of where objects stand; None without relations in the training scenes.
    """

    manifest: Manifest
    weights: Weights
    vocabulary: Vocabulary
    calibration: Calibration
    digest: str
    card: str
    path: Path
    offsets: Offsets | None = None
    counts: Counts | None = None
    places: Places | None = None

    @cached_property
    def key(self) -> tuple[str, str]:
        """Name and version of the model."""
        return self.manifest.name, self.manifest.version

    @cached_property
    def reference(self) -> ModelReference:
        """Name, version, variant and digest of the model, in the form of the field `model`."""
        name, version = self.key
        return ModelReference(
            name=name, version=version, variant=self.manifest.variant, digest=self.digest
        )

    @cached_property
    def spec(self) -> MachineSpec:
        """Sizes and form of the machine."""
        return self.weights.spec

    @cached_property
    def objects(self) -> ObjectScorer:
        """Log-odds of classes and room types. The first access prepares the weights."""
        return ObjectScorer(self.weights)

    @cached_property
    def relation_units(self) -> RelationUnits:
        """Relation units of the machine. The first access prepares the weights."""
        return relation_units(self.weights)

    @cached_property
    def relation_slopes(self) -> RelationSlopes:
        """Calibration of the relations, as arrays."""
        return RelationSlopes.of(self.calibration)

    @cached_property
    def intruder_prior(self) -> NDArray[np.float64]:
        """(V,) log prior that an intruder has each class, up to a constant: alpha · popularity.

        A class that no training scene shows counts as the rarest other class.
        """
        calibration, none = self.calibration, np.zeros(0, np.int64)
        if not calibration.popularity:
            return np.zeros(self.spec.V)
        popularity = np.array(calibration.popularity, dtype=np.float64)
        nothing = self.weights["c1"], none, none.astype(np.float32)
        alone = self.objects.absent(*nothing, profile=None, coverage=1.0)
        rarest, alpha = np.nanmin(popularity), calibration.popularity_weight
        return np.where(np.isnan(popularity), alone - (1 - alpha) * rarest, alpha * popularity)

    @cached_property
    def rarely_shown(self) -> NDArray[np.bool_]:
        """(V,) True for classes that fewer than `RARELY` of the training scenes show."""
        if not self.calibration.popularity:
            return np.zeros(self.spec.V, np.bool_)
        popularity = np.array(self.calibration.popularity, dtype=np.float64)
        return ~(popularity >= math.log(RARELY / (1 - RARELY)))  # NaN: no training scene

    @cached_property
    def row_map(self) -> RowMap:
        """Regression from word vectors to weights. The first access takes about 0.5 s."""
        return RowMap.fit(self.weights, self.vocabulary)

    def with_words(self, words: Sequence[Word]) -> "Artifact":
        """Return the model with a further class for each word, in the order of the words.

        The weights of such a class are predicted (`RowMap`). Its relations and its places are those
        of the nearest class. It never raises an alarm.
        """
        if not words:
            return self
        names = tuple(word.name for word in words)
        kept = self._with_words.get(names)
        if kept is None:
            popularity = self.calibration.popularity
            popularity = (*popularity, *(None for _ in words if popularity))
            kept = replace(
                self,
                weights=self.row_map.with_words(self.weights, words),
                vocabulary=self.vocabulary.with_words(words),
                calibration=self.calibration.model_copy(update={"popularity": popularity}),
            )
            # A reference to this model would close a cycle; see `app.serving.runtime`.
            stand_in = kept.vocabulary.stand_in
            vars(kept)["relation_units"] = StandIns(kept.weights, self.relation_units, stand_in)
            if len(self._with_words) >= _MOST_KEPT:
                self._with_words.clear()  # in one step, because other threads read it
            self._with_words[names] = kept
        return kept

    @cached_property
    def _with_words(self) -> dict[tuple[str, ...], "Artifact"]:
        return {}

    @cached_property
    def scene_chains(self) -> SceneChains:
        """Compiled Gibbs chains that sample scenes."""
        return SceneChains(self.weights, self.relation_units, self.calibration.rare_rooms)


def write_artifact(
    directory: Path,
    description: Description,
    state: Mapping[str, ArrayLike],
    *,
    storage_dtype: StorageDtype = "float32",
) -> Manifest:
    """Write an artifact into a new directory, whose parent exists, and sync it to disk.

    Args:
        state: maps names to arrays. It contains the arrays of `layout`, and optionally those of
            `Offsets.tensors()`, `Counts.tensors()` and `Places.tensors()`.
        storage_dtype: dtype of floating-point tensors with two or more axes; see `pack`.

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
    """Read and verify an artifact.

    Args:
        directory: directory with exactly the three files of an artifact.
        previous: an earlier artifact, which the function returns if its digest is unchanged.
        max_weights_bytes: maximum size of the weights file, checked before the file is read.

    Raises:
        ArtifactError: the artifact is invalid. The exception describes the first error found.
    """
    manifest, text, stored, card = _read_verified(directory, max_weights_bytes)
    digest = _digest(text)
    if previous is not None and previous.digest == digest:
        return previous
    tensors = unpack(stored, manifest.tensors)
    offsets, counts, places = (
        {name: tensors.pop(name) for name in list(tensors) if name.startswith(group.prefix)}
        for group in (Offsets, Counts, Places)
    )
    weights = _weights(manifest, tensors)
    A, V, C = weights.spec.A, weights.spec.V, len(manifest.vocabulary.room_types)
    return Artifact(
        manifest=manifest,
        weights=weights,
        vocabulary=manifest.vocabulary.vocabulary(),
        calibration=manifest.calibration,
        digest=digest,
        card=card,
        path=directory,
        offsets=Offsets.from_tensors(offsets, A, V) if offsets else None,
        counts=Counts.from_tensors(counts, V, C) if counts else None,
        places=Places.from_tensors(places, A, V) if places else None,
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
    try:
        return read_file(path, limit)
    except FileNotFoundError:
        raise ArtifactError("missing_file", f"the artifact has no file {path.name}") from None
    except OSError as error:
        raise _unreadable(path.name, error) from None


def _unreadable(what: str, error: OSError) -> ArtifactError:
    return ArtifactError("unreadable", f"{what} cannot be read: {cause(error)}")


def _read_checked(path: Path, manifest: Manifest, limit: int) -> bytes:
    name, entry = path.name, manifest.files[path.name]
    _require_size(name, entry.bytes, limit)
    data = _read(path, entry.bytes)
    if len(data) < entry.bytes:
        raise ArtifactError("truncated", f"{name} has only {len(data)} of {entry.bytes} bytes")
    if _digest(data) != entry.sha256:
        reason = f"{name} does not match its checksum: the file was altered"
        raise ArtifactError("checksum_mismatch", reason)
    return data
