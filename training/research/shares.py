"""How much of an answer comes from the machine, and how much from counts.

    python -m training.research.shares places-triway@4.5.1 scenes.jsonl

The command asks the questions of the evaluation about the scenes of a file, with the whole model
and with variants in which a part of the scores is left out. No variant is calibrated again, so the
metrics are ranks.

    hidden context   the relations see the hidden units of an empty scene
    relation score   log p(relation) of a missing object at a place, or the relation scores z, d
                     and u of misplaced entries; u has the prior of possibility
    counts           counts of classes at places, shares of stands and of supporters
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from app.inference.weights import Weights
from app.model import SceneModel
from app.model.calibration import KINDS
from app.registry import DEFAULT_STORE, Store
from training.domain.terminal import StorePath
from training.evaluation.asking import artifact_model
from training.evaluation.report import read_test
from training.evaluation.tasks import TASKS
from training.fit.regression import recalibrated

_LIMIT = 600


def without_context(artifact: SceneModel) -> SceneModel:
    """Return the model whose hidden units do not see the objects."""
    arrays = artifact.weights.arrays
    W = np.zeros_like(arrays["W"])
    return replace(artifact, weights=Weights(artifact.spec, {**arrays, "W": W}))


def at_a_place(**entries: float) -> Callable[[SceneModel], SceneModel]:
    """Return a function that changes the weights of the scores at a place."""

    def change(artifact: SceneModel) -> SceneModel:
        fits = tuple(fit.model_copy(update=entries) for fit in artifact.calibration.at)
        return recalibrated(artifact, at=fits)

    return change


def misplaced(**entries: float) -> Callable[[SceneModel], SceneModel]:
    """Return a function that changes the weights of the scores of misplaced entries."""

    def change(artifact: SceneModel) -> SceneModel:
        original = artifact.calibration.misplaced
        fits = {kind: getattr(original, kind) for kind in KINDS}  # None: not fitted
        update = {kind: fit and fit.model_copy(update=entries) for kind, fit in fits.items()}
        return recalibrated(artifact, misplaced=original.model_copy(update=update))

    return change


def whole(artifact: SceneModel) -> SceneModel:
    """Return the model itself."""
    return artifact


_CONTEXT: dict[str, Callable[[SceneModel], SceneModel]] = {
    "whole": whole,
    "without hidden context": without_context,
}

VARIANTS: dict[tuple[str, str], dict[str, Callable[[SceneModel], SceneModel]]] = {
    ("T1a relations", "R-precision, distinct classes"): _CONTEXT,
    ("T1 pairs", "accuracy"): _CONTEXT,
    ("T2-at missing at a place", "MRR"): {
        "whole": whole,
        "without relation score": at_a_place(relation=0.0),
        "without counts": at_a_place(counts=0.0),
        "without both": at_a_place(relation=0.0, counts=0.0),
    },
    ("T3c moved", "named first"): {
        "whole": whole,
        "without relation score": misplaced(relation=0.0, change=0.0, unknown=0.0),
        "without counts": misplaced(stand=0.0, supporter=0.0),
    },
}
"""Variants of a model by the task and the metric that show them."""


def main(
    model: Annotated[str, typer.Argument(help="stored model, NAME@VERSION")],
    file: Annotated[Path, typer.Argument(help="scenes in any format that training reads")],
    store: StorePath = DEFAULT_STORE,
) -> None:
    """Print the metrics of a model and of its variants on the scenes of a file."""
    models = Store(store)
    artifact = models.load(*models.resolve(model)).model
    setting = read_test(file).setting(artifact.vocabulary, limit=_LIMIT)
    for (task, metric), variants in VARIANTS.items():
        for name, change in variants.items():
            outcome = TASKS[task](artifact_model(change(artifact)), setting)
            if outcome and metric in outcome.metrics:
                typer.echo(f"{task}, {metric}: {name} {outcome.metrics[metric].figure()}")


if __name__ == "__main__":
    typer.run(main)
