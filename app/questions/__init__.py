"""The four questions, as functions of a published model and a scene.

    relations   How do these objects stand to each other?
    missing     What else should be here, and where?
    outliers    What does not belong here, or stands in the wrong place?
    generate    What would a scene like this look like?

The first three questions compute expectations, in closed form or with fixed random numbers. So the
same scene always gets the same answer. `generate` draws random scenes. Answers refer to an object
by its position in the scene's list.
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
