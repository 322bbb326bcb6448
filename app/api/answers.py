"""Answers of models as responses."""

from __future__ import annotations

from typing import Any

from starlette.responses import Response

from app.serving.answers import written


def respond(answer: Any) -> Response:
    """An answer as it is.

    Its schema, which the route declares, describes it: to validate it would cost as much as to
    write it, and could only fail after the work. The tests do.
    """
    return Response(written(answer), media_type="application/json")
