"""The questions that the service answers: each module reads a request, asks the model, and answers.

A new question is a module here and an entry in `QUESTIONS`.
"""

from __future__ import annotations

from typing import Any, Final

from app.serving.questions.generate import GENERATE
from app.serving.questions.missing import MISSING
from app.serving.questions.outliers import OUTLIERS
from app.serving.questions.question import Question
from app.serving.questions.relations import RELATIONS

QUESTIONS: Final[tuple[Question[Any], ...]] = (RELATIONS, MISSING, OUTLIERS, GENERATE)
"""In the order of the documentation."""

__all__ = ["QUESTIONS", "Question"]
