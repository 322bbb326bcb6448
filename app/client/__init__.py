"""Clients of the service, which need neither torch nor FastAPI; see docs/clients.md."""

from __future__ import annotations

from app.client.asynchronous import AsyncClient
from app.client.errors import (
    AnswerError,
    ClientError,
    DeadlineError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
)
from app.client.offline import OfflineClient
from app.client.stream import StreamClient, StreamClosedError, StreamProblemError
from app.client.sync import Client

__all__ = [
    "AnswerError",
    "AsyncClient",
    "Client",
    "ClientError",
    "DeadlineError",
    "InvalidRequestError",
    "OfflineClient",
    "ProblemError",
    "StreamClient",
    "StreamClosedError",
    "StreamProblemError",
    "UnreachableError",
]
