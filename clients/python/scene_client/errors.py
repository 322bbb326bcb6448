"""The errors that a call raises."""

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
    """The call failed."""

    def __reduce__(self) -> tuple[Any, ...]:
        # Restores the attributes without calling the class, so that process pools can pass errors
        # on.
        return _restored, (type(self), self.args, self.__dict__)


class InvalidRequestError(ClientError, ValueError):
    """The request is malformed, so it was not sent.

    Attributes:
        errors: the errors, with their places in the body of the request.
    """

    def __init__(self, errors: Sequence[FieldError]) -> None:
        super().__init__("; ".join(_placed(error) for error in errors))
        self.errors = list(errors)


class ProblemError(ClientError):
    """The service answered with a problem (RFC 9457).

    Attributes:
            type: stable path of the problem's page (``/problems/unknown-labels``); branch on it.
                ``about:blank`` if the answer is not from the service, for example from a proxy.
            status: HTTP status.
            title: text that all problems of a type share.
            detail: text about this problem.
            errors: the errors in the request, with their places and similar known names.
            failures: entries of the store that a refresh refused, with reasons.
            request_id: id of the request in the service's log; empty if the service sent none.
            retry_after: seconds to wait before the next request.
    """

    def __init__(
        self,
        type: str,  # noqa: A002 — the name in RFC 9457
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
    """The connection failed or broke before an answer arrived."""


class DeadlineError(ClientError):
    """The timeout expired before the answer arrived.

    Attributes:
        request_id: id of the request if the service stopped it; else empty.
    """

    def __init__(self, message: str, request_id: str = "") -> None:
        super().__init__(message)
        self.request_id = request_id


class AnswerError(ClientError):
    """The service succeeded, and the client cannot read its answer."""


def problem_of(status: int, headers: Mapping[str, str], body: bytes) -> ProblemError:
    """Return the problem of a response whose status is not 200.

    Args:
        headers: headers with lower-case names.
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
    # From a proxy or another server. Its text may change at any time, so it is left out.
    try:
        title = HTTPStatus(status).phrase
    except ValueError:
        title = "Unknown status"
    return ProblemError(
        "about:blank",
        status,
        title,
        "The answer is not a problem document of the service.",
        request_id=headers.get("x-request-id", ""),
        retry_after=retry_after,
    )


def _seconds(retry_after: str | None) -> float | None:
    """Return Retry-After (RFC 9110, section 10.2.3) in seconds from now."""
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
    # "#" means the whole body: the error has no field, or is not in the body.
    where = "" if error.pointer == "#" else f"{error.pointer}: "
    return where + _worded(error)


def _worded(error: FieldError) -> str:
    if not error.suggestions:
        return error.message
    return f"{error.message} (did you mean {', '.join(error.suggestions)}?)"
