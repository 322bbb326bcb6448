"""One version of a model: written once, verified whenever it is read."""

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
from app.inference.objects import ContextScorer
from app.inference.posterior import ClosedForm, Completions
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
_UNSUPPORTED: Final = "only machines in the local form with weights W between -64 and 64 are served"


@dataclass(frozen=True, eq=False)
class Artifact:
    """A verified model, ready to be asked.

    Attributes:
        manifest: everything the trainer said about it.
        weights: of the machine.
        vocabulary: the words of its V object classes and C room types.
        calibration: from log-odds to promised probabilities.
        digest: SHA-256 of the manifest's bytes, hexadecimal; it changes if any file does.
        card: the model card, Markdown.
        path: the directory it was read from.
        offsets: how far apart things stand, where training saw poses.
        oracle: makes the posterior of a scene for machines without closed form, which training has.
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
        """Prepared scores of all objects; made when first asked for."""
        return ContextScorer(self.weights["W"])

    @cached_property
    def closed_form(self) -> ClosedForm:
        """Log-odds in closed form, prepared."""
        return ClosedForm(self.weights)

    @cached_property
    def completions(self) -> Completions | None:
        """Posterior of unlisted classes, prepared; None for machines without stored samples."""
        if not Completions.fits(self.weights):
            return None
        return Completions(self.weights, self.vocabulary.structure, self.scorer)

    @cached_property
    def relation_slopes(self) -> RelationSlopes:
        """The calibration of relations in arrays."""
        return RelationSlopes.of(self.calibration)

    @cached_property
    def popularity(self) -> NDArray[np.float64] | None:
        """(V,) log-odds of each class in a training scene; None where the calibration has none."""
        found = self.calibration.popularity
        return np.array(found) if found else None

    @cached_property
    def empty_gain(self) -> NDArray[np.float32]:
        """(V,) what the context adds to the log-odds of each class in an otherwise empty scene."""
        gain: NDArray[np.float32] = self.scorer.gain(self.weights["c1"])
        return gain

    def context_rows(self) -> NDArray[np.float32]:
        """(T, H1) what each triple that has a weight of its own says of the context."""
        relation, subject, object_ = self.weights["triples"].astype(np.int64).T.copy()
        return self.spec.kind.units(self.weights).rows_of(relation, subject, object_)

    @cached_property
    def scene_chains(self) -> SceneChains:
        """Compiled chains that draw scenes."""
        return SceneChains(self.weights, self.closed_form.units)


def write_artifact(
    directory: Path,
    description: Description,
    state: Mapping[str, ArrayLike],
    *,
    storage_dtype: StorageDtype = "float32",
) -> Manifest:
    """Write an artifact into a new directory and bring it to disk.

    Args:
        directory: must not exist; its parent must.
        description: the manifest but for what describes the files.
        state: the arrays of `layout`, and `Offsets.tensors()` where there are any.
        storage_dtype: of tensors with two axes or more; see `pack`.

    Raises:
        ArtifactError: a tensor that an artifact cannot hold; see `pack`.
        OSError: from the file system.
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
        directory: holds the three files and nothing else.
        previous: an artifact loaded before. The files are verified all the same, but where their
            digest is unchanged, `previous` itself is returned instead of a second copy.
        max_weights_bytes: a larger weights file is refused before it is read.

    Raises:
        ArtifactError: with the code and reason of the first thing found wrong.
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
