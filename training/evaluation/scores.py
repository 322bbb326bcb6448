"""A machine's scores of relations and of classes at a place, by the estimate the service uses.

Machines that have a closed form (see `app.inference.closed_form`) are scored by it, the others by
draws of the context, in the module of each task. A published model is asked for classes at a place
as the service asks it: by its coverage and its calibration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from app.inference.closed_form import ClosedForm
from app.inference.relation_part import Given
from app.inference.scoring import ContextScorer
from app.reasoning.calibration import placed_logits
from app.reasoning.placements import place_log_p
from app.reasoning.posterior import posterior
from app.registry import Artifact
from training.batches import Batch
from training.evaluation import placed, relations
from training.evaluation.asking import of_classes
from training.evaluation.completion import given_score
from training.evaluation.placed import PlacedScore, Places
from training.evaluation.relations import RelationScore
from training.machines import BoltzmannMachine
from training.machines.arrays import weights_of


@dataclass(frozen=True, eq=False)
class MachineScores:
    """Scores of one machine.

    Attributes:
        relations: T1a, whatever the batch says of relations.
        completion: T1b and T3b, given the batch's observed relations, each without itself.
        placed: T2-at.
    """

    relations: RelationScore
    completion: RelationScore
    placed: PlacedScore


def machine_scores(machine: BoltzmannMachine) -> MachineScores:
    """In closed form where there is one."""
    weights = weights_of(machine)
    if not ClosedForm.fits(weights):
        return MachineScores(
            relations.machine_score(machine),
            given_score(machine),
            placed.machine_score(machine),
        )
    closed = ClosedForm(weights)
    return MachineScores(
        _relation_score(closed, given=False),
        _relation_score(closed, given=True),
        _placed_score(closed, ContextScorer(weights["W"])),
    )


def _relation_score(closed: ClosedForm, *, given: bool) -> RelationScore:
    def score(batch: Batch) -> Tensor:
        found = torch.full(batch.holds.shape, -torch.inf)
        for row, padded in enumerate(batch.classes):
            n = int((padded >= 0).sum())
            told = _given(batch, row, n) if given else None
            context = closed.context(
                padded[:n].numpy(), np.ones(n, np.float32), _logs(batch.counts[row, :n]), None, told
            )
            found[row, :, :n, :n] = torch.from_numpy(closed.relation_log_odds(context))
        return found

    return score


def _given(batch: Batch, row: int, n: int) -> Given:
    a, i, j = batch.observed[row, :, :n, :n].numpy().nonzero()
    holds = batch.holds[row].numpy()[a, i, j]
    return Given(a, i, j, holds, np.ones_like(holds))


def _placed_score(closed: ClosedForm, scorer: ContextScorer) -> PlacedScore:
    def score(places: Places) -> Tensor:
        found = torch.full(places.v.shape, -torch.inf)
        for row, v in enumerate(places.v):
            (classes,), (absent,) = v.numpy().nonzero(), (v == 0).numpy().nonzero()
            context = closed.context(
                classes, np.ones(len(classes), np.float32), _logs(places.counts[row, classes])
            )
            log_odds = closed.placed_log_odds(
                *(context, absent, int(places.relation[row])),
                int(np.searchsorted(classes, int(places.anchor[row]))),
                bool(places.outgoing[row]),
            )
            values = -np.logaddexp(0.0, -(closed.b + scorer.gain(context.y))[absent])
            values -= np.logaddexp(0.0, -log_odds)
            found[row, absent] = torch.from_numpy(values).float()
        return found

    return score


def served_placed_score(artifact: Artifact) -> PlacedScore:
    """Calibrated logits of a published model: p(there unlisted) · p(stands so | there)."""
    calibration, structure = artifact.calibration, artifact.vocabulary.structure

    def score(places: Places) -> Tensor:
        found = torch.full(places.v.shape, -torch.inf)
        for row, v in enumerate(places.v.numpy()):
            classes = np.flatnonzero(v)
            counts = places.counts[row, classes].clamp(min=1).long().numpy()
            given = posterior(artifact, of_classes(np.repeat(classes, counts).tolist()))
            absent = np.flatnonzero((v == 0) & ~structure)
            z = given.absent_posterior(absent, calibration.coverage)
            log_p = place_log_p(
                *(artifact, given, absent, int(places.relation[row])),
                int(np.searchsorted(classes, int(places.anchor[row]))),
                outgoing=bool(places.outgoing[row]),
            )
            listed = max(1, int(np.count_nonzero(~structure[classes])))
            logits = placed_logits(calibration, z, log_p, listed)
            found[row, absent] = torch.from_numpy(logits).float()
        return found

    return score


def _logs(counts: Tensor) -> NDArray[np.float32]:
    """Log of the instances; where nobody counted, that of one."""
    logs: NDArray[np.float32] = counts.clamp(min=1).float().log().numpy()
    return logs
