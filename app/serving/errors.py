"""Why a question cannot be answered, in terms of scenes and models; HTTP is not known here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from scene_client.schemas import Failure

Location = tuple[str | int, ...]
"""A way into a request: field names and list positions."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong with a request.

    Attributes:
        location: where, from the root of the request.
        message: what; never a copy of the input.
        suggestions: nearest known names, best first.
    """

    location: Location
    message: str
    suggestions: tuple[str, ...] = ()


class Reason(Enum):
    """The kind of fault that a client may want to branch on."""

    INVALID = "invalid"
    UNKNOWN_LABELS = "unknown labels"
    CONTRADICTION = "contradiction"
    ANSWER_TOO_LARGE = "answer too large"


class ServingError(Exception):
    """Base of what the service can say about a request; its text is fit for the client."""


class RequestError(ServingError):
    """A request that fits the schema but makes no sense to this model or in itself."""

    def __init__(self, reason: Reason, faults: Sequence[Fault]) -> None:
        super().__init__(reason.value)
        self.reason = reason
        self.faults = tuple(faults)


class UnknownModelError(ServingError):
    """No alias, model or version has this name."""


class ModelUnavailableError(ServingError):
    """The version is in the store, but it was refused when it was loaded."""


class NotReadyError(ServingError):
    """Nothing is being served yet, or the default model is not usable."""


class QueueFullError(ServingError):
    """More is waiting than the service will hold."""


class DeadlinePassedError(ServingError):
    """The request's time was over before its answer was there."""


class DisconnectedError(ServingError):
    """The client has left."""


class DrainingError(ServingError):
    """The service is ending and takes nothing new."""


class AliasConflictError(ServingError):
    """The alias does not lead where the request expected, or cannot have this name."""


class ModelUnusableError(ServingError):
    """An alias was to lead to a version that was refused."""


class StoreNotWritableError(ServingError):
    """The store's aliases cannot be changed from here."""


class StoreBusyError(ServingError):
    """Another process is writing to the store."""


class RefreshRefusedError(ServingError):
    """What the store holds now is worse than what is served.

    Attributes:
        failures: what was wrong with it.
    """

    def __init__(self, failures: Sequence[Failure]) -> None:
        super().__init__("refused")
        self.failures = tuple(failures)
