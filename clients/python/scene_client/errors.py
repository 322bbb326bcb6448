"""The errors of a call, and the error of a response."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus
from typing import Any

from pydantic import ValidationError

from scene_client.schemas import Failure, FieldError, Problem


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


def problem_of(status: int, headers: Mapping[str, str], body: bytes) -> ProblemError:
    """The problem of a response other than 200.

    Args:
        headers: by their names in lower case.
    """
    retry_after = _seconds(headers.get("retry-after"))
    with suppress(ValidationError):
        problem = Problem.model_validate_json(body, extra="ignore")
        return ProblemError(
            problem.type,
            status,
            problem.title,
            problem.detail,
            errors=problem.errors or (),
            failures=problem.failures or (),
            request_id=problem.request_id,
            retry_after=retry_after,
        )
    # Of a proxy or another server: the wording of such an answer may change at any time.
    try:
        title = HTTPStatus(status).phrase
    except ValueError:
        title = "Unknown status"
    return ProblemError(
        "about:blank",
        status,
        title,
        "The answer is no problem document of the service.",
        request_id=headers.get("x-request-id", ""),
        retry_after=retry_after,
    )


def _seconds(retry_after: str | None) -> float | None:
    """Retry-After (RFC 9110, section 10.2.3) in seconds from now."""
    if retry_after is None:
        return None
    if retry_after.isascii() and retry_after.isdigit():
        return float(retry_after)
    with suppress(ValueError):
        moment = parsedate_to_datetime(retry_after)
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=UTC)
        return max(0.0, (moment - datetime.now(UTC)).total_seconds())
    return None


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
