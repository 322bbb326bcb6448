"""One version of a model: written once, verified at every read."""

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
from app.registry.description import Calibration, Description
from app.registry.durable import sync_directory, write_file
from app.registry.errors import ArtifactError
from app.registry.manifest import CARD, MANIFEST, WEIGHTS, FileEntry, Manifest
from app.registry.offsets import PREFIX, Offsets
from app.registry.slopes import RelationSlopes
from app.registry.tensors import StorageDtype, pack, require_equal, unpack
from app.registry.verified import MAX_WEIGHTS_BYTES, read_verified
from app.scene.scene import Scene
from app.scene.vocabulary import Vocabulary

_DTYPES: Final = {float: "float32", int: "int32"}
_UNSUPPORTED: Final = "the service needs a machine of the local form, with W between -64 and 64"


@dataclass(frozen=True, eq=False)
class Artifact:
    """A verified model, ready to answer questions.

    Attributes:
        manifest: description of the model and its files.
        weights: weights of the machine.
        vocabulary: names of its V object classes and C room types.
        calibration: conversion of log-odds into probabilities.
        digest: SHA-256 of the manifest's bytes, hexadecimal. It changes if any file changes.
        card: the model card, Markdown.
        path: directory of the artifact.
        offsets: metric offsets between related objects, if the training scenes had poses.
        oracle: function that returns the posterior of a scene, for machines without closed form;
            used in training only.
    """

    manifest: Manifest
    weights: Weights
    vocabulary: Vocabulary
    calibration: Calibration
    digest: str
    card: str
    path: Path
    offsets: Offsets | None = None
    oracle: Callable[[Artifact, Scene], Any] | None = None

    @cached_property
    def spec(self) -> MachineSpec:
        """The shape of the machine."""
        return self.weights.spec

    @cached_property
    def scorer(self) -> ContextScorer:
        """Scorer of all object classes; built on first access."""
        return ContextScorer(self.weights["W"])

    @cached_property
    def closed_form(self) -> ClosedForm:
        """Log-odds in closed form; built on first access."""
        return ClosedForm(self.weights)

    @cached_property
    def completions(self) -> Completions | None:
        """Posterior of unlisted classes; None for machines without stored samples."""
        if not Completions.fits(self.weights):
            return None
        return Completions(self.weights, self.vocabulary.structure, self.scorer)

    @cached_property
    def relation_slopes(self) -> RelationSlopes:
        """Calibration of the relations, as arrays."""
        return RelationSlopes.of(self.calibration)

    @cached_property
    def popularity(self) -> NDArray[np.float64] | None:
        """(V,) log-odds of each class in a training scene; None if the calibration lacks them."""
        found = self.calibration.popularity
        return np.array(found) if found else None

    @cached_property
    def empty_gain(self) -> NDArray[np.float32]:
        """(V,) contribution of the context to the log-odds of each class in an empty scene."""
        gain: NDArray[np.float32] = self.scorer.gain(self.weights["c1"])
        return gain

    def context_rows(self) -> NDArray[np.float32]:
        """(T, H1) input of each relation triple with its own weight to the context units."""
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
        directory: the new directory; its parent must exist.
        description: the manifest without its entries about files.
        state: the arrays of `layout`, and optionally `Offsets.tensors()`.
        storage_dtype: dtype of floating-point tensors with two or more axes; see `pack`.

    Raises:
        ArtifactError: an artifact cannot store a tensor; see `pack`.
        OSError: the file system refused an operation.
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
        previous: an artifact loaded before. If the digest of the verified files is unchanged,
            `previous` itself is returned instead of a second copy.
        max_weights_bytes: maximum size of the weights file, checked before it is read.

    Raises:
        ArtifactError: code and reason of the first error found.
    """
    files = read_verified(directory, max_weights_bytes)
    if previous is not None and previous.digest == files.digest:
        return previous
    manifest = files.manifest
    tensors = unpack(files.weights, manifest.tensors)
    offsets = {name: tensors.pop(name) for name in list(tensors) if name.startswith(PREFIX)}
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
    )


def _weights(manifest: Manifest, tensors: Mapping[str, NDArray[Any]]) -> Weights:
    try:
        spec = MachineSpec.from_dict(dict(manifest.spec))
        expected = layout(spec)
    except (ValueError, TypeError) as error:
        raise ArtifactError("invalid_manifest", f"spec: {error}") from None
    require_equal(
        {name: (array.dtype.name, array.shape) for name, array in tensors.items()},
        {name: (_DTYPES[kind], shape) for name, (kind, shape) in expected.items()},
        "the artifact holds",
        f"a {spec.variant} of this spec needs",
    )
    try:
        weights = Weights(spec, tensors)
    except ValueError as error:
        raise ArtifactError("invalid_tensor", str(error)) from None
    if not ClosedForm.fits(weights):
        raise ArtifactError("unsupported", _UNSUPPORTED)
    return weights
