"""The four questions, as functions of a published model and a scene.

    relations   How do these objects stand to each other?
    missing     What else should be here, and where?
    outliers    What does not belong here, or stands in the wrong place?
    generate    What would a scene like this look like?

All but the last are expectations, in closed form or estimated with fixed random numbers: the same
scene gets the same answer. Objects are named by their position in the scene.
"""

from __future__ import annotations

from app.questions.contexts import ContextUnit, contexts
from app.questions.generate import GeneratedScene, generate
from app.questions.missing import MissingAnswer, Offset, Placement, missing
from app.questions.outliers import (
    MisplacedAnswer,
    OutlierAnswer,
    OutliersFound,
    Sensitivity,
    misplaced,
    outliers,
)
from app.questions.ranking import Because
from app.questions.relations import Disagreement, RelationAnswer, relations

__all__ = [
    "Because",
    "ContextUnit",
    "Disagreement",
    "GeneratedScene",
    "MisplacedAnswer",
    "MissingAnswer",
    "Offset",
    "OutlierAnswer",
    "OutliersFound",
    "Placement",
    "RelationAnswer",
    "Sensitivity",
    "contexts",
    "generate",
    "misplaced",
    "missing",
    "outliers",
    "relations",
]
