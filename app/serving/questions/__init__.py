"""The questions of the service. The module of a question contains its route function.

A route function reads a request, calls the model and builds the answer. To add a question, add a
module to this package and an entry to `QUESTIONS`.
"""

from __future__ import annotations

from typing import Any, Final

from app.serving.questions.generate import GENERATE
from app.serving.questions.missing import MISSING
from app.serving.questions.outliers import OUTLIERS
from app.serving.questions.question import Question
from app.serving.questions.relations import RELATIONS

QUESTIONS: Final[tuple[Question[Any], ...]] = (RELATIONS, MISSING, OUTLIERS, GENERATE)
"""All questions, in the order of the documentation."""

__all__ = ["QUESTIONS", "Question"]
