"""Errors of the serving layer. They do not depend on HTTP."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from scene_client.schemas import Failure

Location = tuple[str | int, ...]
"""Path to a value in a request: field names and list indices, from the root of the request."""

MOST_NAMED: Final = 50
"""Maximum number of known names in the message of an error."""


def some_of(names: Iterable[str]) -> str:
    """Return the first `MOST_NAMED` names in alphabetical order, as text for a message."""
    found = sorted(names)
    text = ", ".join(found[:MOST_NAMED]) or "none"
    return f"{text} and {len(found) - MOST_NAMED} more" if len(found) > MOST_NAMED else text


@dataclass(frozen=True, slots=True)
class Fault:
    """One error in a request.

    Attributes:
        location: path to the invalid value in the request.
        message: description of the error, without a copy of the input.
        suggestions: known names that are similar to an unknown name, most similar name first.
    """

    location: Location
    message: str
    suggestions: tuple[str, ...] = ()


class Reason(Enum):
    """The kind of a `RequestError`. Each kind has its own problem type."""

    INVALID = "invalid"
    UNKNOWN_LABELS = "unknown labels"
    CONTRADICTION = "contradiction"
    ANSWER_TOO_LARGE = "answer too large"


class ServingError(Exception):
    """Base class of the errors of the serving layer. Clients may receive the message."""


class RequestError(ServingError):
    """The request matches the schema, but is contradictory or does not match the model."""

    def __init__(self, reason: Reason, faults: Sequence[Fault]) -> None:
        super().__init__(reason.value)
        self.reason = reason
        self.faults = tuple(faults)


class UnknownModelError(ServingError):
    """The requested alias, model or version does not exist."""


class ModelUnavailableError(ServingError):
    """The version is in the store, but the service refused to load it."""


class NotReadyError(ServingError):
    """The service is still starting, or the default model is not usable."""


class QueueFullError(ServingError):
    """The queue of requests or the queue of the model's scenes is full."""


class DeadlinePassedError(ServingError):
    """The deadline of the request passed before the answer was complete."""


class DisconnectedError(ServingError):
    """The client has closed its connection."""


class DrainingError(ServingError):
    """The service is shutting down, so it is not ready."""


class AliasConflictError(ServingError):
    """The alias does not point to the expected version, or a model has the name of the alias."""


class ModelUnusableError(ServingError):
    """The alias would point to a version that the service refused to load."""


class StoreNotWritableError(ServingError):
    """This process cannot write the aliases of the store."""


class StoreBusyError(ServingError):
    """Another process is writing to the store."""


class RefreshRefusedError(ServingError):
    """The new state of the store would make a working version or alias unusable.

    Attributes:
        failures: for each refused version or alias, its name and the reason.
    """

    def __init__(self, failures: Sequence[Failure]) -> None:
        super().__init__("refused")
        self.failures = tuple(failures)
