"""When to send, when to wait, when to give up: the one core of all clients, without a socket.

`exchange` is a generator. It yields what is to be done, a client does it in its own way (blocking
or not) and sends back what became of it; the answer is what the generator returns.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Generator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from http import HTTPStatus
from typing import Final, TypeAlias

from pydantic import ValidationError

from scene_client.calls import Call, T
from scene_client.errors import (
    AnswerError,
    ClientError,
    DeadlineError,
    ProblemError,
    UnreachableError,
)
from scene_client.schemas import Problem

MAX_TIMEOUT: Final = 600.0
"""Seconds; the service takes no more."""

RETRIES: Final = 5
"""Further attempts at most, as far as there is time for them."""

FIRST_PAUSE: Final = 0.05
LONGEST_PAUSE: Final = 2.0
"""Seconds between attempts where the service names none; they double from the first on."""

MAX_ANSWER: Final = 256 * 2**20
"""Bytes; a batch of 256 scenes with 4,096 relations each stays below."""

_ABOUT_BLANK: Final = "about:blank"


@dataclass(frozen=True, slots=True)
class Send:
    """To do: send the call, and wait for its answer no longer than ``timeout`` seconds."""

    headers: Mapping[str, str]
    timeout: float


@dataclass(frozen=True, slots=True)
class Pause:
    """To do: wait so many seconds."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Received:
    """Outcome: an answer. The names of headers are in lower case."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass(frozen=True, slots=True)
class Lost:
    """Outcome: no answer. ``sent``: the service may have got the request."""

    reason: str
    sent: bool


@dataclass(frozen=True, slots=True)
class Late:
    """Outcome: no answer in time."""


ToDo: TypeAlias = Send | Pause
Outcome: TypeAlias = Received | Lost | Late | None


def exchange(
    call: Call[T],
    timeout: float,
    now: Callable[[], float],
    *,
    retries: int = RETRIES,
    jitter: Callable[[], float] = random.random,
) -> Generator[ToDo, Outcome, T]:
    """Everything from a call to its answer.

    Args:
        timeout: seconds for all of it.
        now: a clock in seconds that never goes back.
        retries: further attempts at most.
        jitter: draws from [0, 1).

    Raises:
        ProblemError, UnreachableError, DeadlineError, AnswerError: there is no answer.
    """
    ends = now() + timeout
    for attempt in range(retries + 1):
        left = ends - now()
        if left <= 0:
            break
        headers = {"X-Request-Timeout-Ms": str(max(1, int(left * 1e3)))}
        outcome = yield Send(headers, left)
        error: ClientError
        asked: float | None = None
        match outcome:
            case Received(status=200):
                answer = _read(call, outcome)
                # Whoever named a deadline has gone on without: an answer after it, be it complete,
                # is none. Asked here, after it was read, which takes time too.
                if now() >= ends:
                    break
                return answer
            case Received():
                problem = problem_of(outcome)
                if problem.status == HTTPStatus.GATEWAY_TIMEOUT:
                    raise DeadlineError(problem.detail or problem.title, problem.request_id)
                if problem.status not in (429, 503):
                    raise problem
                error, asked = problem, problem.retry_after
            case Lost(reason, sent):
                error = UnreachableError(reason)
                if sent and not call.repeatable:
                    raise error
            case _:
                break
        pause = min(LONGEST_PAUSE, FIRST_PAUSE * 2**attempt) * jitter()
        if asked is not None:
            # Never earlier than asked, and not all at once.
            pause = asked + pause
        if attempt == retries or pause >= ends - now():
            raise error
        yield Pause(pause)
    raise DeadlineError(f"No answer within {timeout:g} s.")


def _read(call: Call[T], outcome: Received) -> T:
    try:
        # A newer service may say more than this client knows.
        return call.answer.model_validate_json(outcome.body, extra="ignore")
    except ValidationError as error:
        raise AnswerError(
            f"The answer of {call.path} is not {call.answer.__name__}: "
            f"{error.error_count()} faults. Is this the service's address?"
        ) from None


def problem_of(outcome: Received) -> ProblemError:
    """The problem that an answer other than 200 stands for."""
    retry_after = _seconds(outcome.headers.get("retry-after"))
    with suppress(ValidationError):
        problem = Problem.model_validate_json(outcome.body, extra="ignore")
        return ProblemError(
            problem.type,
            outcome.status,
            problem.title,
            problem.detail,
            errors=problem.errors or (),
            failures=problem.failures or (),
            request_id=problem.request_id,
            retry_after=retry_after,
        )
    # Of a proxy or another server: the wording of such an answer may change at any time.
    try:
        title = HTTPStatus(outcome.status).phrase
    except ValueError:
        title = "Unknown status"
    return ProblemError(
        _ABOUT_BLANK,
        outcome.status,
        title,
        "The answer is no problem document of the service.",
        request_id=outcome.headers.get("x-request-id", ""),
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
