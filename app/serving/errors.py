"""Errors of the serving layer, in terms of scenes and models, independent of HTTP."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from scene_client.schemas import Failure

Location = tuple[str | int, ...]
"""Path to a value of a request: field names and list indices."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One error in a request.

    Attributes:
        location: path to the invalid value, from the root of the request.
        message: description of the error, without a copy of the input.
        suggestions: nearest known names, best first.
    """

    location: Location
    message: str
    suggestions: tuple[str, ...] = ()


class Reason(Enum):
    """The kind of a request error; each kind has its own problem type."""

    INVALID = "invalid"
    UNKNOWN_LABELS = "unknown labels"
    CONTRADICTION = "contradiction"
    ANSWER_TOO_LARGE = "answer too large"


class ServingError(Exception):
    """Base class of the serving errors; the client may read their text."""


class RequestError(ServingError):
    """The request matches the schema, but contradicts itself or does not suit the model."""

    def __init__(self, reason: Reason, faults: Sequence[Fault]) -> None:
        super().__init__(reason.value)
        self.reason = reason
        self.faults = tuple(faults)


class UnknownModelError(ServingError):
    """The name of a model is neither an alias nor a model nor a version."""


class ModelUnavailableError(ServingError):
    """The version is in the store, but the service refused to load it."""


class NotReadyError(ServingError):
    """The service is still starting, or the default model is not usable."""


class QueueFullError(ServingError):
    """The queue of requests, or of the model's scenes, is full."""


class DeadlinePassedError(ServingError):
    """The deadline of the request passed before the answer was complete."""


class DisconnectedError(ServingError):
    """The client has closed its connection."""


class DrainingError(ServingError):
    """The service is shutting down and refuses new requests."""


class AliasConflictError(ServingError):
    """The alias does not point to the expected version, or a model has its name."""


class ModelUnusableError(ServingError):
    """The alias would point to a version that the service refused to load."""


class StoreNotWritableError(ServingError):
    """This process cannot write the aliases of the store."""


class StoreBusyError(ServingError):
    """Another process is writing to the store."""


class RefreshRefusedError(ServingError):
    """The new state of the store would make a working version or alias unusable.

    Attributes:
        failures: the refused versions and aliases, with reasons.
    """

    def __init__(self, failures: Sequence[Failure]) -> None:
        super().__init__("refused")
        self.failures = tuple(failures)
