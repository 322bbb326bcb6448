"""Training objectives, by name: one entry here is trained, tested and documented like the others.

An objective is called with the machine, a batch and a generator, and returns a loss whose gradient
is that of the objective (`Objective`). It may keep state between calls (persistent chains), which a
checkpoint stores.
"""

from __future__ import annotations

from training.objectives.base import Objective
from training.objectives.composite import CompositeLikelihood
from training.objectives.contrastive import ContrastiveDivergence, PersistentCD
from training.objectives.relations import RelationLikelihood

OBJECTIVES: dict[str, type[Objective]] = {
    "contrastive_divergence": ContrastiveDivergence,
    "persistent_cd": PersistentCD,
    "composite": CompositeLikelihood,
    "relations": RelationLikelihood,
}

__all__ = [
    "OBJECTIVES",
    "CompositeLikelihood",
    "ContrastiveDivergence",
    "Objective",
    "PersistentCD",
    "RelationLikelihood",
]
