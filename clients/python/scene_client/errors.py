"""What can go wrong with a call, each kind once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scene_client.schemas import Failure, FieldError


class ClientError(Exception):
    """A call that has no answer."""

    def __reduce__(self) -> tuple[Any, ...]:
        # As it is, not by calling its class again: pools of processes hand errors on.
        return _restored, (type(self), self.args, self.__dict__)


class InvalidRequestError(ClientError, ValueError):
    """The service would refuse the request as malformed, so it was not sent.

    Attributes:
        errors: what is wrong, and where in the request's body.
    """

    def __init__(self, errors: Sequence[FieldError]) -> None:
        super().__init__("; ".join(_placed(error) for error in errors))
        self.errors = list(errors)


class ProblemError(ClientError):
    """The service answered with a problem (RFC 9457).

    Attributes:
        type: stable path of the problem's page (``/problems/unknown-labels``); branch on it. What
            is no problem document of the service, as of a proxy, is ``about:blank``.
        status: HTTP status.
        title: the same for every problem of a type.
        detail: about this one.
        errors: what is wrong with the request and where, with the nearest known names.
        failures: what a refresh refused, and why.
        request_id: to find it in the service's log; empty where none was sent.
        retry_after: seconds after which the service wants to be asked again.
    """

    def __init__(
        self,
        type: str,  # noqa: A002 — the name that RFC 9457 gives it
        status: int,
        title: str,
        detail: str,
        *,
        errors: Sequence[FieldError] = (),
        failures: Sequence[Failure] = (),
        request_id: str = "",
        retry_after: float | None = None,
    ) -> None:
        faults = "".join(f"\n  {error.pointer}: {_worded(error)}" for error in errors)
        super().__init__(f"{status} {type}: {detail or title}{faults}")
        self.type = type
        self.status = status
        self.title = title
        self.detail = detail
        self.errors = list(errors)
        self.failures = list(failures)
        self.request_id = request_id
        self.retry_after = retry_after


class UnreachableError(ClientError):
    """No connection to the service, or one that broke; nothing of an answer came."""


class DeadlineError(ClientError):
    """The call's time was over before its answer was there.

    Attributes:
        request_id: where the service itself gave up; else empty.
    """

    def __init__(self, message: str, request_id: str = "") -> None:
        super().__init__(message)
        self.request_id = request_id


class AnswerError(ClientError):
    """The service succeeded, and its answer is none that this client can read."""


def _restored(kind: type[ClientError], args: tuple[Any, ...], state: dict[str, Any]) -> ClientError:
    error = kind.__new__(kind, *args)
    error.__dict__.update(state)
    return error


def _placed(error: FieldError) -> str:
    # "#" is all of it: the place where a fault is that lies in no field, or not in the request.
    where = "" if error.pointer == "#" else f"{error.pointer}: "
    return where + _worded(error)


def _worded(error: FieldError) -> str:
    if not error.suggestions:
        return error.message
    return f"{error.message} (did you mean {', '.join(error.suggestions)}?)"
