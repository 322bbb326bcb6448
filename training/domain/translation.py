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
from jaxtyping import Bool, Float, Int
from torch import Tensor

from app.model import Sensitivity
from app.scene import Vocabulary
from training.datasets.batches import Batch
from training.evaluation.setting import (
    Flagged,
    Model,
    ObjectScore,
    PlacedScore,
    Places,
    RelationScore,
)

BEYOND = 1e9  # absolute score of unknown classes: finite, and larger than all log-odds


def same_classes(a: Vocabulary, b: Vocabulary) -> bool:
    """Return whether each index names the same class in both; sizes and aliases may differ."""
    return a.labels == b.labels and bool((a.structure == b.structure).all())


@dataclass(frozen=True, eq=False)
class Translation:
    """Mapping from the classes of scenes to the classes of a model."""

    model_class: Int[Tensor, "V"]  # model class of each scene class; -1: unknown
    size: int  # number of model classes W
    unknown: float = -BEYOND  # score of unknown classes

    @classmethod
    def between(cls, scenes: Vocabulary, model: Vocabulary) -> Translation:
        """Match the classes of two vocabularies by name, and then by alias."""
        model_class = []
        for entry in scenes.objects:
            indices = [model.index(name) for name in (entry.label, *entry.aliases)]
            model_class.append(next((index for index in indices if index is not None), -1))
        return cls(torch.tensor(model_class, dtype=torch.int64), len(model))

    def translate(self, model: Model) -> Model:
        """Return the model with scores that take scenes and return values in the scene classes.

        Unknown classes rank last. In T3b (false relations), the lowest score ranks first.
        """
        reverse = replace(self, unknown=BEYOND)
        wrapper_of: dict[str, Callable[[Any], Any]] = {
            "missing": self._objects,
            "suspicion": self._objects,
            "flags": self._flags,
            "at_place": self._placed,
            "relations": self._relations,
            "completion": self._relations,
            "false_relations": reverse._relations,
        }
        scores = {
            name: wrap(score)
            for name, wrap in wrapper_of.items()
            if (score := getattr(model, name)) is not None
        }
        return Model(**scores, parameters=model.parameters)

    def presence(self, v: Float[Tensor, "B V"]) -> Float[Tensor, "B W"]:
        """Map presence or counts of scene classes to model classes, by their maximum."""
        is_mapped = self.model_class >= 0
        index = self.model_class[is_mapped].expand(len(v), -1)
        return torch.zeros(len(v), self.size).scatter_reduce(1, index, v[:, is_mapped], "amax")

    def scores(self, values: Float[Tensor, "B W"]) -> Float[Tensor, "B V"]:
        """Map scores of model classes to scene classes; unknown classes get `unknown`."""
        scores = values[:, self.model_class.clamp(min=0)]
        return scores.masked_fill(self.model_class < 0, self.unknown)

    def _objects(self, score: ObjectScore) -> ObjectScore:
        return lambda v: self.scores(score(self.presence(v)))

    def _flags(self, flags: Flagged) -> Flagged:
        def flag_scene_classes(
            v: Float[Tensor, "B V"], sensitivity: Sensitivity
        ) -> Bool[Tensor, "B V"]:
            """Return the flags of the listed classes that the model has; the others get none."""
            flagged = flags(self.presence(v), sensitivity)[:, self.model_class.clamp(min=0)]
            return flagged & (self.model_class >= 0) & (v > 0)

        return flag_scene_classes

    def _placed(self, score: PlacedScore) -> PlacedScore:
        def score_scene_classes(places: Places) -> Tensor:
            """Score the places whose anchor class the model has; the others get `unknown`."""
            anchor = self.model_class[places.anchor]
            scores = torch.full_like(places.v, self.unknown)
            rows = (anchor >= 0).nonzero().squeeze(1)
            if len(rows):
                part = replace(places, anchor=anchor).rows(rows)
                v, counts = self.presence(part.v), self.presence(part.counts)
                model_places = replace(part, v=v, counts=counts)
                # Other present classes may map to the anchor's model class; the score is then -inf.
                scores[rows] = self.scores(score(model_places).clamp(min=-BEYOND))
            return scores

        return score_scene_classes

    def _relations(self, score: RelationScore) -> RelationScore:
        def score_scene_classes(batch: Batch) -> Tensor:
            """Score the relations of each scene alone: classes of a scene can map to one class."""
            scores = torch.full(batch.holds.shape, self.unknown)
            for row in range(len(batch)):
                self._score_row(score, batch, row, scores[row])
            return scores

        return score_scene_classes

    def _score_row(
        self, score: RelationScore, batch: Batch, row: int, scores: Float[Tensor, "A n n"]
    ) -> None:
        """Write the scores of one scene, for classes that the model has."""
        classes = batch.classes[row]
        mapped = torch.where(classes >= 0, self.model_class[classes.clamp(min=0)], -1)
        columns = (mapped >= 0).nonzero().squeeze(1)
        if not len(columns):
            return
        model_classes, index_of = mapped[columns].unique(return_inverse=True)
        n, A = len(model_classes), batch.holds.shape[1]
        counts = torch.zeros(n, dtype=torch.int64)
        counts.index_add_(0, index_of, batch.counts[row, columns])
        model_pair = (slice(None), index_of[:, None], index_of[None, :])
        scene_pair = (slice(None), columns[:, None], columns[None, :])
        # Scene classes that map to one model class share their observed relations.
        pair = (index_of[:, None] * n + index_of).flatten().expand(A, -1)

        def pooled(relations: Tensor) -> Tensor:
            values = relations[row][scene_pair].float().flatten(1)
            return torch.zeros(A, n * n).scatter_reduce(1, pair, values, "amax").view(1, A, n, n)

        model_scene = replace(
            batch.rows(torch.tensor([row])),
            v=torch.zeros(1, self.size).index_fill(1, model_classes, 1.0),
            classes=model_classes.unsqueeze(0),
            counts=counts.unsqueeze(0),
            holds=pooled(batch.holds * batch.observed),
            observed=pooled(batch.observed).bool(),
            room=torch.tensor([-1]),
        )
        values = score(model_scene)[0].clamp(min=-BEYOND)[model_pair]
        # The model has no relations between two objects of the same class.
        classes_differ = index_of[:, None] != index_of[None, :]
        scores[scene_pair] = torch.where(classes_differ, values, torch.tensor(self.unknown))
