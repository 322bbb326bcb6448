"""Artifacts: the files of one version of a model, and the loaded model.

Every read of an artifact verifies its files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.inference import MachineSpec, Weights
from app.inference.chains import SceneChains
from app.inference.completions import Completions
from app.inference.objects import ContextScorer
from app.inference.posterior import ClosedForm
from app.inference.weights import layout
from app.registry.card import render_card
from app.registry.counts import PREFIX as COUNTS
from app.registry.counts import Counts
from app.registry.description import Calibration, Description
from app.registry.durable import sync_directory, write_file
from app.registry.errors import ArtifactError
from app.registry.manifest import CARD, MANIFEST, WEIGHTS, FileEntry, Manifest
from app.registry.offsets import PREFIX as OFFSETS
from app.registry.offsets import Offsets
from app.registry.slopes import RelationSlopes
from app.registry.tensors import StorageDtype, pack, require_equal, unpack
from app.registry.verified import MAX_WEIGHTS_BYTES, read_verified
from app.scene.scene import Scene
from app.scene.vocabulary import Vocabulary

_DTYPES: Final = {float: "float32", int: "int32"}
_UNSUPPORTED: Final = (
    "the service does not support this machine: it needs the local form and weights W between -64 "
    "and 64"
)


@dataclass(frozen=True, eq=False)
class Artifact:
    """A verified model, ready to answer questions.

    Attributes:
        manifest: description of the model and its files.
        weights: weights of the machine.
        vocabulary: names of the model's V object classes and C room types.
        calibration: conversion of log-odds into probabilities.
        digest: SHA-256 of the manifest's bytes as a hexadecimal string. The digest changes if any
            file of the artifact changes.
        card: model card in Markdown.
        path: directory of the artifact.
        offsets: vectors in metres between the centres of related objects. None means that the
            training scenes had no poses.
        counts: statistics of the numbers of instances. None means that the training scenes do not
            count instances.
        oracle: function that computes the posterior of a scene in place of the closed form. Only
            training sets an oracle.
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
    oracle: Callable[[Artifact, Scene], Any] | None = None

    @cached_property
    def spec(self) -> MachineSpec:
        """Sizes and form of the machine."""
        return self.weights.spec

    @cached_property
    def scorer(self) -> ContextScorer:
        """Scorer that computes the log-odds of all object classes. The first access builds it."""
        return ContextScorer(self.weights["W"])

    @cached_property
    def closed_form(self) -> ClosedForm:
        """The machine, prepared for log-odds in closed form. The first access prepares it."""
        return ClosedForm(self.weights)

    @cached_property
    def completions(self) -> Completions | None:
        """Posterior of unlisted classes. None means that the machine has no stored samples."""
        if not Completions.fits(self.weights):
            return None
        return Completions(self.weights, self.vocabulary.structure, self.scorer)

    @cached_property
    def relation_slopes(self) -> RelationSlopes:
        """Calibration of the relations, as arrays."""
        return RelationSlopes.of(self.calibration)

    @cached_property
    def popularity(self) -> NDArray[np.float64] | None:
        """(V,) log-odds that a training scene has each class. None means that they are unknown."""
        found = self.calibration.popularity
        return np.array(found) if found else None

    @cached_property
    def empty_gain(self) -> NDArray[np.float32]:
        """(V,) contribution of the hidden units h1 to each class's log-odds in an empty scene."""
        gain: NDArray[np.float32] = self.scorer.gain(self.weights["c1"])
        return gain

    def context_rows(self) -> NDArray[np.float32]:
        """Return the weights between h1 and each of the T triples of the weights, (T, H1)."""
        relation, subject, object_ = self.weights["triples"].astype(np.int64).T.copy()
        return self.spec.kind.units(self.weights).rows_of(relation, subject, object_)

    @cached_property
    def scene_chains(self) -> SceneChains:
        """Compiled Gibbs chains that sample scenes."""
        return SceneChains(self.weights, self.closed_form.units)


def write_artifact(
    directory: Path,
    description: Description,
    state: Mapping[str, ArrayLike],
    *,
    storage_dtype: StorageDtype = "float32",
) -> Manifest:
    """Write an artifact into a new directory and sync it to disk.

    Args:
        directory: the new directory. Its parent must exist.
        description: contents of the manifest without the entries about files.
        state: maps names to arrays. It contains the arrays of `layout`, and optionally those of
            `Offsets.tensors()` and of `Counts.tensors()`.
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
            name: FileEntry(sha256=hashlib.sha256(data).hexdigest(), bytes=len(data))
            for name, data in ((WEIGHTS, weights), (CARD, card))
        },
    )
    directory.mkdir(mode=0o755)
    for name, data in ((WEIGHTS, weights), (CARD, card), (MANIFEST, manifest.to_bytes())):
        write_file(directory / name, data)
    sync_directory(directory)
    return manifest


def load_artifact(
    directory: Path,
    previous: Artifact | None = None,
    max_weights_bytes: int = MAX_WEIGHTS_BYTES,
) -> Artifact:
    """Read and verify an artifact.

    Args:
        directory: directory with exactly the three files of an artifact.
        previous: an artifact that was loaded earlier. If the verified files have the same digest,
            the function returns `previous` instead of a second copy. None means that no artifact
            was loaded earlier.
        max_weights_bytes: maximum size of the weights file. The function checks the size before it
            reads the file.

    Raises:
        ArtifactError: the artifact is invalid. The exception describes the first error found.
    """
    files = read_verified(directory, max_weights_bytes)
    if previous is not None and previous.digest == files.digest:
        return previous
    manifest = files.manifest
    tensors = unpack(files.weights, manifest.tensors)
    offsets, counts = _taken(tensors, OFFSETS), _taken(tensors, COUNTS)
    weights = _weights(manifest, tensors)
    return Artifact(
        manifest=manifest,
        weights=weights,
        vocabulary=manifest.vocabulary.vocabulary(),
        calibration=manifest.calibration,
        digest=files.digest,
        card=files.card,
        path=directory,
        offsets=Offsets.from_tensors(offsets, weights.spec.A, weights.spec.V) if offsets else None,
        counts=Counts.from_tensors(counts, weights.spec.V, len(manifest.vocabulary.room_types))
        if counts
        else None,
    )


def _taken(tensors: dict[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Remove the tensors with a prefix from a dictionary, and return them."""
    return {name: tensors.pop(name) for name in list(tensors) if name.startswith(prefix)}


def _weights(manifest: Manifest, tensors: Mapping[str, NDArray[Any]]) -> Weights:
    try:
        spec = MachineSpec.from_dict(dict(manifest.spec))
        expected = layout(spec)
    except (ValueError, TypeError) as error:
        raise ArtifactError(
            "invalid_manifest", f"the manifest has an invalid spec: {error}"
        ) from None
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
    if not ClosedForm.fits(weights):
        raise ArtifactError("unsupported", _UNSUPPORTED)
    return weights
