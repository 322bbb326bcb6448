"""Clients of the scene-reasoning service: plain httpx and pydantic; see docs/clients.md."""

from __future__ import annotations

from scene_client.asynchronous import AsyncClient
from scene_client.errors import (
    AnswerError,
    ClientError,
    DeadlineError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
)
from scene_client.offline import OfflineClient
from scene_client.stream import StreamClient, StreamClosedError, StreamProblemError
from scene_client.sync import Client

__version__ = "1.0.0"

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
