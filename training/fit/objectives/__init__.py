"""Training objectives by name.

The trainer calls an objective with the machine, a batch and a random generator. The objective
returns a loss whose gradient is the update direction (`Objective`). An objective can keep state
between calls, for example persistent chains. Checkpoints store this state.
"""

from __future__ import annotations

from training.fit.objectives.base import Objective
from training.fit.objectives.composite import CompositeLikelihood
from training.fit.objectives.contrastive import ContrastiveDivergence, PersistentCD
from training.fit.objectives.relation_likelihood import RelationLikelihood

OBJECTIVES: dict[str, type[Objective]] = {
    "contrastive_divergence": ContrastiveDivergence,
    "persistent_cd": PersistentCD,
    "composite": CompositeLikelihood,
    "relations": RelationLikelihood,
}

__all__ = ["OBJECTIVES", "Objective"]
