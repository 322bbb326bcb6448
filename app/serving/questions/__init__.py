"""The four questions: each reads a request, asks the model about the scene, and returns the answer.

Each raises:
    RequestError, UnknownModelError, ModelUnavailableError: see `Request.read`.
    RequestError: the answer would be too large.
    QueueFullError, DeadlinePassedError, DisconnectedError: see `Request.ask`.
"""

from app.serving.questions.generate import generate
from app.serving.questions.missing import missing
from app.serving.questions.outliers import outliers
from app.serving.questions.relations import relations

__all__ = ["generate", "missing", "outliers", "relations"]
