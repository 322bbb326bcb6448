"""What becomes known about one request while it is answered."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Final

from scene_client.schemas import ModelReference

SUCCESS: Final = "success"


@dataclass(slots=True)
class RequestRecord:
    """Filled in by those who serve the request; read once, when its response has been sent.

    Attributes:
        outcome: `SUCCESS`, or the name of the problem it was answered with.
        models: those it asked, by (name, version); a batch may ask several.
        queue_seconds: how long its scenes waited, together; None where none had to.
        compute_seconds: how long the models computed for it; None where none was asked.
        answered_at: `time.perf_counter` when the last answer of a model came.
        stream: of a stream its messages, answers, superseded updates and the code of its close.
    """

    outcome: str = SUCCESS
    models: set[tuple[str, str]] = field(default_factory=set)
    queue_seconds: float | None = None
    compute_seconds: float | None = None
    answered_at: float | None = None
    stream: dict[str, int] = field(default_factory=dict)

    def asked(self, model: ModelReference) -> None:
        """The request is for this model."""
        self.models.add((model.name, model.version))

    def waited(self, seconds: float) -> None:
        """A scene of the request stood in the queue."""
        self.queue_seconds = (self.queue_seconds or 0.0) + seconds

    def computed(self, seconds: float) -> None:
        """A model has answered about a scene of the request."""
        self.compute_seconds = (self.compute_seconds or 0.0) + seconds
        self.answered_at = time.perf_counter()

    def known(self) -> dict[str, str | float]:
        """The record for a line of the log: times in milliseconds, the model if there is one."""
        entry: dict[str, str | float] = {"outcome": self.outcome, **self.stream}
        if len(self.models) == 1:
            ((entry["model"], entry["version"]),) = self.models
        if self.queue_seconds is not None:
            entry["queue_ms"] = round(self.queue_seconds * 1e3, 3)
        if self.compute_seconds is not None:
            entry["compute_ms"] = round(self.compute_seconds * 1e3, 3)
        return entry
