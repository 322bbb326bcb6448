"""A model asked about scenes in another model's classes.

Each class of the scenes is what the model calls by its name, or nothing. Classes that the model
pools under one name share its answer. What it does not know it is not shown; it can neither
propose such a thing, which therefore comes last, nor suspect it, which therefore comes last too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from app.scene import Vocabulary
from training.batches import Batch
from training.evaluation.missing import ObjectScore, PlacedScore, Places
from training.evaluation.relations import RelationScore
from training.evaluation.setting import Contender

Score = TypeVar("Score")

# Beyond every log-odds, and finite: unknown classes tie for the last places.
BEYOND = 1e9


def same_classes(a: Vocabulary, b: Vocabulary) -> bool:
    """The two mean the same by every class index; sizes and aliases may differ."""
    return a.labels == b.labels and bool((a.structure == b.structure).all())


@dataclass(frozen=True, eq=False)
class Translation:
    """From the classes of scenes to those of a model.

    Attributes:
        own: (V,) int64, the model's class of each class of the scenes, -1 for none.
        size: how many classes the model has.
        unknown: the score of what it has no class for.
    """

    own: Tensor
    size: int
    unknown: float = -BEYOND

    @classmethod
    def between(cls, scenes: Vocabulary, model: Vocabulary) -> Translation:
        """By name, then by alias."""
        own = []
        for entry in scenes.objects:
            named = (model.index(name) for name in (entry.label, *entry.aliases))
            own.append(next((index for index in named if index is not None), -1))
        return cls(torch.tensor(own, dtype=torch.int64), len(model))

    def contender(self, model: Contender, task: str) -> Contender:
        """The model as one that understands the scenes' classes.

        Args:
            task: in T3 and T3b what scores low is suspected, in others what scores high proposed.
        """
        if task.startswith("T3"):
            return replace(self, unknown=BEYOND)._contender(model)
        return self._contender(model)

    def _contender(self, model: Contender) -> Contender:
        return Contender(
            objects=_maybe(self._objects, model.objects),
            relations=_maybe(self._relations, model.relations),
            completion=_maybe(self._relations, model.completion),
            placed=_maybe(self._placed, model.placed),
            placement=_maybe(self._relations, model.placement),
            parameters=model.parameters,
        )

    def presence(self, v: Tensor) -> Tensor:
        """(B, V) presence or counts of the scenes' classes as (B, model's V), the larger of two."""
        known = self.own >= 0
        index = self.own[known].expand(len(v), -1)
        return torch.zeros(len(v), self.size).scatter_reduce(1, index, v[:, known], "amax")

    def scores(self, values: Tensor) -> Tensor:
        """(B, model's V) scores as (B, V), `unknown` where the model knows no such class."""
        found = values[:, self.own.clamp(min=0)]
        return found.masked_fill(self.own < 0, self.unknown)

    def _objects(self, score: ObjectScore) -> ObjectScore:
        return lambda v: self.scores(score(self.presence(v)))

    def _placed(self, score: PlacedScore) -> PlacedScore:
        def translated(places: Places) -> Tensor:
            anchor = self.own[places.anchor]
            found = torch.full_like(places.v, self.unknown)
            if (known := (anchor >= 0).nonzero().squeeze(1)).numel():
                own = Places(
                    v=self.presence(places.v[known]),
                    counts=self.presence(places.counts[known]),
                    relation=places.relation[known],
                    anchor=anchor[known],
                    outgoing=places.outgoing[known],
                )
                # A class that is present under a name shared with the missing one is no candidate.
                values = score(own).clamp(min=-BEYOND)
                found[known] = self.scores(values)
            return found

        return translated

    def _relations(self, score: RelationScore) -> RelationScore:
        def translated(batch: Batch) -> Tensor:
            found = torch.full(batch.holds.shape, self.unknown)
            for row in range(len(batch)):
                self._score_row(score, batch, row, found[row])
            return found

        return translated

    def _score_row(self, score: RelationScore, batch: Batch, row: int, found: Tensor) -> None:
        """Fill in what the model says of one scene; (A, n, n)."""
        classes = batch.classes[row]
        own = torch.where(classes >= 0, self.own[classes.clamp(min=0)], -1)
        kept = (own >= 0).nonzero().squeeze(1)
        if not len(kept):
            return
        known, place = own[kept].unique(return_inverse=True)
        n, A = len(known), batch.holds.shape[1]
        counts = torch.zeros(n, dtype=torch.int64).index_add(0, place, batch.counts[row, kept])
        holds, observed = torch.zeros(A, n, n), torch.zeros(A, n, n, dtype=torch.bool)
        pair = (slice(None), place[:, None], place[None, :])
        told = (slice(None), kept[:, None], kept[None, :])
        # Where two classes are one to the model, what is told of either is told of it.
        for a, i, j in batch.observed[row][told].nonzero().tolist():
            observed[a, place[i], place[j]] = True
            holds[a, place[i], place[j]] += batch.holds[row][told][a, i, j]
        small = replace(
            batch.rows(torch.tensor([row])),
            v=torch.zeros(1, self.size).index_fill(1, known, 1.0),
            classes=known.unsqueeze(0),
            counts=counts.unsqueeze(0),
            holds=holds.clamp(max=1.0).unsqueeze(0),
            observed=observed.unsqueeze(0),
            room=torch.tensor([-1]),
        )
        values = score(small)[0].clamp(min=-BEYOND)[pair]
        # Of two things that it calls by one name the model says nothing.
        apart = place[:, None] != place[None, :]
        found[told] = torch.where(apart, values, torch.tensor(self.unknown))


def _maybe(change: Callable[[Score], Score], score: Score | None) -> Score | None:
    return None if score is None else change(score)
