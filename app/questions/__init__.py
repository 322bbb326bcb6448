"""The questions about a scene and about a home. The module of a question has all about it.

    relations   Which spatial relations hold between the objects of the scene?
    missing     Which unlisted objects are probably in the scene, and where? `more` adds the listed
                classes with probably more instances than listed.
    outliers    Which objects do not belong to the scene, and which stated relations are wrong?
    rooms       Of which room type is the scene, or where is such an object?
    generate    Which other scenes contain these objects and relations?
    where       In which room of a home is such a thing, and where in the room?

The function of a question takes a published model and a scene. It returns the fields of the answer,
as `scene_client.schemas` defines them. All questions but `generate` compute expectations, in closed
form or with fixed random numbers. So the same scene always gets the same answer. `generate` draws
random scenes. In the examples of the functions, `model` is the default model of the shipped store:
`store.load(*store.resolve("default")).model`. To add a question, add a module to this package and
its record to `QUESTIONS`.
"""

from typing import Any, Final

from app.questions.generate import GENERATE, generate
from app.questions.missing import MISSING, missing
from app.questions.outliers import OUTLIERS, misplaced, outliers
from app.questions.question import Question
from app.questions.relations import RELATIONS, relations
from app.questions.rooms import ROOMS, rooms
from app.questions.where import WHERE, where

QUESTIONS: Final[tuple[Question[Any], ...]] = (
    *(RELATIONS, MISSING, OUTLIERS, ROOMS, GENERATE, WHERE),
)
"""All questions, in the order of the documentation."""

__all__ = [
    "QUESTIONS", "Question", "generate", "misplaced", "missing", "outliers", "relations", "rooms",
    "where",
]  # fmt: skip
