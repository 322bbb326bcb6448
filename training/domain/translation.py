"""Query a model with scenes whose classes are the classes of another model.

Each class of the scenes is looked up in the model by name. Several scene classes can map to the
same model class: they get the same score. A class that the model lacks is unknown: objects of this
class are not part of the model's input, and this class ranks last in every task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from app.scene import Vocabulary
from training.datasets.batches import Batch
from training.evaluation.model import Model, ObjectScore, PlacedScore, Places, RelationScore

# Absolute score of unknown classes. The score is finite and larger than all log-odds, so that
# unknown classes rank last.
BEYOND = 1e9


def same_classes(a: Vocabulary, b: Vocabulary) -> bool:
    """Return whether each index names the same class in both; sizes and aliases may differ."""
    return a.labels == b.labels and bool((a.structure == b.structure).all())


@dataclass(frozen=True, eq=False)
class Translation:
    """Mapping from the classes of scenes to the classes of a model.

    Attributes:
        own: (V,) int64, the model's class for each of the V scene classes; -1 for an unknown class.
    """

    own: Tensor
    size: int
    unknown: float = -BEYOND

    @classmethod
    def between(cls, scenes: Vocabulary, model: Vocabulary) -> Translation:
        """Match the classes of two vocabularies by name, and then by alias."""
        own = []
        for entry in scenes.objects:
            named = (model.index(name) for name in (entry.label, *entry.aliases))
            own.append(next((index for index in named if index is not None), -1))
        return cls(torch.tensor(own, dtype=torch.int64), len(model))

    def model(self, model: Model) -> Model:
        """Return the model with scores that take scenes and return values in the scene classes.

        In T3 (outliers) and T3b (false relations), the lowest score ranks first. In other tasks,
        the highest score ranks first. Unknown classes rank last in every task.
        """
        reverse = replace(self, unknown=BEYOND)
        translated: dict[str, Callable[[Any], Any]] = {
            "missing": self._objects,
            "outliers": reverse._objects,
            "at_place": self._placed,
            "relations": self._relations,
            "completion": self._relations,
            "false_relations": reverse._relations,
        }
        scores = {
            name: translate(score)
            for name, translate in translated.items()
            if (score := getattr(model, name)) is not None
        }
        return Model(**scores, parameters=model.parameters)

    def presence(self, v: Tensor) -> Tensor:
        """Map presence or counts from the scene classes to the model's classes.

        `v` has the shape (scenes, scene classes); the result has the shape (scenes, model classes).
        If several scene classes map to one model class, the result is their maximum.
        """
        has_class = self.own >= 0
        index = self.own[has_class].expand(len(v), -1)
        return torch.zeros(len(v), self.size).scatter_reduce(1, index, v[:, has_class], "amax")

    def scores(self, values: Tensor) -> Tensor:
        """Map scores (scenes, model classes) to scene classes; unknown classes get `unknown`."""
        scores = values[:, self.own.clamp(min=0)]
        return scores.masked_fill(self.own < 0, self.unknown)

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
                # Other present classes may map to the anchor's model class; the score is then -inf.
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
        """Write the scores of one scene into `found`, with shape (relations, classes, classes)."""
        classes = batch.classes[row]
        own = torch.where(classes >= 0, self.own[classes.clamp(min=0)], -1)
        kept = (own >= 0).nonzero().squeeze(1)
        if not len(kept):
            return
        model_classes, index_of = own[kept].unique(return_inverse=True)
        n, A = len(model_classes), batch.holds.shape[1]
        counts = torch.zeros(n, dtype=torch.int64).index_add(0, index_of, batch.counts[row, kept])
        holds, observed = torch.zeros(A, n, n), torch.zeros(A, n, n, dtype=torch.bool)
        pair = (slice(None), index_of[:, None], index_of[None, :])
        scene_pair = (slice(None), kept[:, None], kept[None, :])
        # Scene classes that map to one model class share their observed relations.
        for a, i, j in batch.observed[row][scene_pair].nonzero().tolist():
            observed[a, index_of[i], index_of[j]] = True
            holds[a, index_of[i], index_of[j]] += batch.holds[row][scene_pair][a, i, j]
        small = replace(
            batch.rows(torch.tensor([row])),
            v=torch.zeros(1, self.size).index_fill(1, model_classes, 1.0),
            classes=model_classes.unsqueeze(0),
            counts=counts.unsqueeze(0),
            holds=holds.clamp(max=1.0).unsqueeze(0),
            observed=observed.unsqueeze(0),
            room=torch.tensor([-1]),
        )
        values = score(small)[0].clamp(min=-BEYOND)[pair]
        # The model has no relations between two objects of the same class.
        apart = index_of[:, None] != index_of[None, :]
        found[scene_pair] = torch.where(apart, values, torch.tensor(self.unknown))
