"""One version of a model: written once, verified whenever it is read."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.registry.card import render_card
from app.registry.description import Calibration, Description
from app.registry.durable import sync_directory, write_file
from app.registry.errors import ArtifactError
from app.registry.manifest import CARD, MANIFEST, WEIGHTS, FileEntry, Manifest
from app.registry.offsets import PREFIX, Offsets
from app.registry.slopes import RelationSlopes
from app.registry.tensors import StorageDtype, pack, require_equal, unpack
from app.registry.verified import read_verified
from app.scene.vocabulary import Vocabulary

if TYPE_CHECKING:  # importing torch takes seconds; writing and listing artifacts does without
    from app.boltzmann import BoltzmannMachine
    from app.boltzmann.closed_form import ClosedForm
    from app.boltzmann.completions import Completions
    from app.boltzmann.fantasies import Fantasies
    from app.boltzmann.scene_chains import SceneChains
    from app.boltzmann.scoring import ContextScorer


@dataclass(frozen=True, eq=False)
class Artifact:
    """A verified model, ready to be asked.

    Attributes:
        manifest: everything the trainer said about it.
        machine: in evaluation mode, float32, without gradients.
        vocabulary: the words of its V object classes and C room types.
        calibration: from log-odds to promised probabilities.
        digest: SHA-256 of the manifest's bytes, hexadecimal; it changes if any file does.
        card: the model card, Markdown.
        path: the directory it was read from.
        offsets: how far apart things stand, where training saw poses.
    """

    manifest: Manifest
    machine: BoltzmannMachine
    vocabulary: Vocabulary
    calibration: Calibration
    digest: str
    card: str
    path: Path
    offsets: Offsets | None = None

    @cached_property
    def scorer(self) -> ContextScorer:
        """Prepared scores of all objects; made when first asked for."""
        from app.boltzmann.scoring import ContextScorer

        return ContextScorer(self.machine)

    @cached_property
    def closed_form(self) -> ClosedForm | None:
        """Log-odds in closed form, prepared; None for machines that have none."""
        from app.boltzmann.closed_form import ClosedForm

        return ClosedForm(self.machine) if ClosedForm.fits(self.machine) else None

    @cached_property
    def completions(self) -> Completions | None:
        """Posterior of unlisted classes, prepared; None for machines without stored samples."""
        from app.boltzmann.completions import Completions

        if not Completions.fits(self.machine):
            return None
        return Completions(self.machine, self.vocabulary.structure, self.scorer)

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
        return self.scorer.row_gain(self.machine.c1.detach().float().numpy())

    @cached_property
    def scene_chains(self) -> SceneChains | None:
        """Compiled chains that draw scenes; None for machines that have none."""
        from app.boltzmann.scene_chains import SceneChains

        return SceneChains(self.machine) if SceneChains.fits(self.machine) else None

    @cached_property
    def fantasies(self) -> Fantasies:
        """Where chains start; made when first asked for."""
        from app.boltzmann.fantasies import Fantasies

        return Fantasies(self.machine)


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
        state: the machine's `state_dict()`, or numpy arrays of the same names, and
            `Offsets.tensors()` where there are any.
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


def load_artifact(directory: Path, previous: Artifact | None = None) -> Artifact:
    """Read and verify an artifact.

    Args:
        directory: holds the three files and nothing else.
        previous: an artifact loaded before. The files are verified all the same, but where their
            digest is unchanged, `previous` itself is returned instead of a second copy.

    Raises:
        ArtifactError: with the code and reason of the first thing found wrong.
    """
    files = read_verified(directory)
    if previous is not None and previous.digest == files.digest:
        return previous
    manifest = files.manifest
    tensors = unpack(files.weights, manifest.tensors)
    offsets = {name: tensors.pop(name) for name in list(tensors) if name.startswith(PREFIX)}
    machine = _machine(manifest, tensors)
    return Artifact(
        manifest=manifest,
        machine=machine,
        vocabulary=manifest.vocabulary.vocabulary(),
        calibration=manifest.calibration,
        digest=files.digest,
        card=files.card,
        path=directory,
        offsets=Offsets.from_tensors(offsets, machine.spec.A, machine.spec.V) if offsets else None,
    )


def _machine(manifest: Manifest, tensors: Mapping[str, NDArray[Any]]) -> BoltzmannMachine:
    import torch

    from app.boltzmann import MachineSpec, build

    try:
        spec = MachineSpec.from_dict(dict(manifest.spec))
        # On the meta device nothing is allocated, however large a spec claims to be.
        with torch.device("meta"):
            machine = build(spec)
    except (ValueError, TypeError, RuntimeError, OverflowError) as error:
        raise ArtifactError("invalid_manifest", f"spec: {error}") from None
    state = {name: torch.from_numpy(array) for name, array in tensors.items()}
    require_equal(
        {name: (tensor.dtype, tuple(tensor.shape)) for name, tensor in state.items()},
        {
            name: (tensor.dtype, tuple(tensor.shape))
            for name, tensor in machine.state_dict().items()
        },
        "the artifact holds",
        f"a {spec.variant} of this spec needs",
    )
    try:
        machine.load_state_dict(state, assign=True)
    except ValueError as error:
        raise ArtifactError("invalid_tensor", str(error)) from None
    return machine.eval().requires_grad_(False)
