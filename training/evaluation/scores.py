"""Scores of a model's relations and of classes at a place, as the service computes them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from app.questions.posterior import posterior
from app.registry import Artifact
from app.scene import CANONICAL, OPPOSITES, Scene
from training.batches import Batch
from training.evaluation.asking import missing_probabilities, of_classes
from training.evaluation.placed import PlacedScore, Places
from training.evaluation.relations import RelationScore


def relation_score(artifact: Artifact, *, given: bool) -> RelationScore:
    """Log-odds of every relation between the classes of a batch, each without itself.

    Args:
        given: the relations that the batch observes as on are stated; otherwise none is.
    """

    def score(batch: Batch) -> Tensor:
        found = torch.full(batch.holds.shape, -torch.inf)
        stated = batch.holds * batch.observed * given
        for row, padded in enumerate(batch.classes):
            n = int((padded >= 0).sum())
            scene, first = _instances(padded[:n], batch.counts[row, :n])
            told = set(map(tuple, stated[row].nonzero().tolist()))
            # a(x, y) and a(y, x) both hold of classes where they hold of different instances.
            last = first + batch.counts[row, :n].clamp(min=1) - 1
            triples = [
                (a, *(last[[x, y]] if (a, y, x) in told and x > y else first[[x, y]]).tolist())
                for a, x, y in sorted(told)
            ]
            scene = Scene(scene.objects, tuple(triples) or None)
            values = posterior(artifact, scene).relation_log_odds()
            found[row, : len(values), :n, :n] = torch.from_numpy(values)
        return found

    return score


def placed_score(artifact: Artifact) -> PlacedScore:
    """Log-probabilities of `/missing` at a place, -inf for what it does not propose."""

    def score(places: Places) -> Tensor:
        rows = []
        for row, v in enumerate(places.v):
            classes = v.nonzero().squeeze(1)
            scene, first = _instances(classes, places.counts[row, classes])
            relation = CANONICAL[int(places.relation[row])]
            anchor = int(first[int((classes == places.anchor[row]).nonzero())])
            # The question names the place from the missing object's side.
            name = relation if places.outgoing[row] else OPPOSITES[relation]
            p = missing_probabilities(artifact, scene, at=(name, anchor))
            tiny = np.finfo(np.float64).tiny
            rows.append(np.where(p >= 0, np.log(np.maximum(p, tiny)), -np.inf))
        return torch.from_numpy(np.stack(rows)).to(places.v.dtype)

    return score


def _instances(classes: Tensor, counts: Tensor) -> tuple[Scene, Tensor]:
    """So many objects of each class, one where nobody counted, and the place of each first one."""
    each = counts.clamp(min=1).long()
    return of_classes(classes.repeat_interleave(each).tolist()), each.cumsum(0) - each
