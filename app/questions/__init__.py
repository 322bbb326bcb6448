"""The four questions, as functions of a published model and a scene.

    relations   Which spatial relations hold between the objects of the scene?
    missing     Which unlisted objects are probably in the scene, and where? `more` adds the listed
                classes with probably more instances than listed.
    outliers    Which objects do not belong to the scene, and which stated relations are wrong?
    generate    Which other scenes contain these objects and relations?

The first three questions compute expectations, in closed form or with fixed random numbers. So the
same scene always gets the same answer. `generate` draws random scenes. Answers refer to an object
by its index in `Scene.objects`.
"""

from __future__ import annotations

from app.questions.contexts import ContextUnit, contexts
from app.questions.counts import More, more
from app.questions.generate import GeneratedScene, generate
from app.questions.missing import MissingAnswer, Placement, missing
from app.questions.outliers import (
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
    "MissingAnswer",
    "More",
    "OutlierAnswer",
    "OutliersFound",
    "Placement",
    "RelationAnswer",
    "Sensitivity",
    "contexts",
    "generate",
    "misplaced",
    "missing",
    "more",
    "outliers",
    "relations",
]
