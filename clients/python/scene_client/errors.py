"""The exceptions that a call of the client can raise."""

from __future__ import annotations

import copyreg
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from email.utils import parsedate_to_datetime
from http.client import responses
from typing import Any, Final

from pydantic import ValidationError
from typing_extensions import Self

from scene_client.schemas import FieldError, Problem
from scene_client.untrusted import printable, printable_lines


class ClientError(Exception):
    """Base class of the exceptions. A call of the client failed. The text suits a terminal."""

    def __str__(self) -> str:
        return printable_lines(super().__str__())

    def __reduce__(self) -> tuple[Any, ...]:
        # Process pools pickle exceptions. Pickle must not call the constructors of subclasses.
        return copyreg.__newobj__, (type(self), *self.args), self.__dict__  # type: ignore[attr-defined]


_LONGEST_LINE: Final = 270
"""Maximum length of the errors in the text of an `InvalidRequestError` in characters."""


class InvalidRequestError(ClientError, ValueError):
    """The request is invalid. The client has not sent it. The text contains the first errors.

    Attributes:
        errors: list of the errors. Each error has a location in the body of the request.
    """

    def __init__(self, errors: Sequence[FieldError]) -> None:
        line = ""
        for shown, error in enumerate(errors):
            longer = line + "; " * bool(line) + _located_message(error)
            if line and len(longer) > _LONGEST_LINE:
                line += f"; and {len(errors) - shown} more errors"
                break
            line = longer
        super().__init__(line)
        self.errors = list(errors)

    @classmethod
    def about(cls, message: str, pointer: str = "#") -> Self:
        """Return the exception for one error, by default an error of the whole request."""
        return cls([FieldError(pointer=pointer, message=message)])


MOST_SHOWN: Final = 10
"""Maximum number of errors in the text of an exception."""
_LONGEST_QUOTE: Final = 128  # characters, the maximum of an id


class ProblemError(ClientError):
    """The service answered with a problem (RFC 9457).

    The text of the exception contains the title, the detail and the first errors.

    Attributes:
        type: path of the page about the problem type, such as ``/problems/unknown-labels``. The
            path never changes, so programs can compare it. The type is ``about:blank`` if another
            server, such as a proxy, has sent the answer.
        status: HTTP status code of the response.
        title: short summary. All problems of one type have the same title.
        detail: description of this problem.
        errors: errors in the request. Each error has a location and similar known names.
        request_id: id of the request in the log of the service, or "" if the response has no id.
        retry_after: seconds to wait before the next request, or None if the response has no time.
    """

    def __init__(
        self,
        type: str,  # noqa: A002 — the name in RFC 9457
        status: int,
        title: str,
        detail: str,
        *,
        errors: Sequence[FieldError] = (),
        request_id: str = "",
        retry_after: float | None = None,
    ) -> None:
        lines = [f"{status} {title} ({type}): {detail}"]
        lines += [f"{error.pointer}: {_message(error)}" for error in errors[:MOST_SHOWN]]
        if len(errors) > MOST_SHOWN:
            lines.append(f"and {len(errors) - MOST_SHOWN} more errors")
        super().__init__("\n  ".join(map(printable, lines)))
        self.type = type
        self.status = status
        self.title = title
        self.detail = detail
        self.errors = list(errors)
        self.request_id = request_id
        self.retry_after = retry_after


class UnreachableError(ClientError):
    """The connection failed before the answer arrived."""


class DeadlineError(ClientError):
    """The timeout expired before the answer arrived.

    Attributes:
        request_id: id of the request, if the service stopped the request at its deadline. It is ""
            if the client stopped waiting.
    """

    def __init__(self, message: str, request_id: str = "") -> None:
        super().__init__(message)
        self.request_id = request_id


class AnswerError(ClientError):
    """The client cannot read the answer of the service."""


class UnknownThingError(ClientError, LookupError):
    """A home has no thing with this id, for example because the thing is gone."""


class HomeFileError(ClientError, ValueError):
    """The file of a home is damaged, or a newer client has written it. It is left as it is."""


def problem_of(
    status: int, headers: Mapping[str, str], body: bytes, request: str | None = None
) -> ProblemError:
    """Return the problem of a response with an error status.

    Args:
        status: HTTP status.
        headers: headers of the response, with lower-case names.
        body: body of the response.
        request: body of the request. The messages quote its texts, because the service never
            repeats text of a request.
    """
    try:
        problem = Problem.model_validate_json(body, extra="ignore")
    except ValidationError:
        # The response comes from a proxy or another server. The error does not contain the text of
        # the response, because this text may change at any time.
        problem = Problem(
            type="about:blank",
            status=status,
            title=responses.get(status, "Unknown status"),
            detail="The answer comes from another server, for example from a proxy.",
            instance="",
            request_id=headers.get("x-request-id", ""),
        )
    return ProblemError(
        problem.type,
        status,
        problem.title,
        problem.detail,
        errors=_quoted(problem.errors or (), request or "null"),
        request_id=problem.request_id,
        retry_after=_seconds(headers.get("retry-after", "")),
    )


def _quoted(errors: Sequence[FieldError], request: str) -> Sequence[FieldError]:
    body = json.loads(request) if errors else None
    return [
        error.model_copy(
            update={"message": f"{json.dumps(text, ensure_ascii=False)}: {error.message}"}
        )
        if (text := _text_at(body, error.pointer))
        else error
        for error in errors
    ]


def _text_at(body: Any, pointer: str) -> str | None:
    """Return the text at a JSON pointer, or the label of the object there, or None."""
    with suppress(LookupError, TypeError, ValueError):
        for part in pointer.split("/")[1:]:
            body = body[int(part)] if isinstance(body, list) else body[part]
        text = body["label"] if isinstance(body, dict) else body
        return text if isinstance(text, str) and len(text) <= _LONGEST_QUOTE else None
    return None


def _seconds(retry_after: str) -> float | None:
    """Return Retry-After (RFC 9110, section 10.2.3) in seconds from now."""
    if retry_after.isascii() and retry_after.isdigit():
        return float(retry_after)
    with suppress(ValueError):
        moment = parsedate_to_datetime(retry_after)
        if moment.tzinfo is None:
            moment = moment.replace(tzinfo=timezone.utc)
        return max(0.0, (moment - datetime.now(timezone.utc)).total_seconds())
    return None


def _located_message(error: FieldError) -> str:
    # The pointer "#" means the whole body, so the message needs no location.
    prefix = "" if error.pointer == "#" else f"{error.pointer}: "
    return prefix + _message(error)


def _message(error: FieldError) -> str:
    if not error.suggestions:
        return error.message
    return f"{error.message} (did you mean {', '.join(error.suggestions)}?)"
