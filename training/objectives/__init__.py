"""Training objectives by name.

An objective is called with the machine, a batch and a generator. It returns a loss whose gradient
is the update direction (`Objective`). It may keep state between calls, such as persistent chains;
checkpoints store this state.
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
