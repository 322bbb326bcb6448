"""Which pages of other origins may ask: CORS, refused with problems."""

from __future__ import annotations

from collections.abc import Sequence

from starlette.datastructures import Headers
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from app.api import catalogue, keys
from app.api.middleware.turnstile import TIMEOUT_HEADER
from app.api.problems import ProblemError, respond


class CrossOrigin(CORSMiddleware):
    """Lets pages of the listed origins ask and read, without cookies, and no others.

    Args:
        app: what answers.
        origins: as browsers send them.
    """

    def __init__(self, app: ASGIApp, origins: tuple[str, ...]) -> None:
        super().__init__(
            app,
            allow_origins=origins,
            # Administration is for people at a terminal: a page needs neither PUT nor its key.
            allow_methods=("GET", "POST"),
            allow_headers=(
                "Authorization",
                "Content-Type",
                keys.API_KEY,
                "X-Request-Id",
                TIMEOUT_HEADER,
            ),
            expose_headers=("Retry-After", "X-Request-Id"),
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        try:
            await super().__call__(scope, receive, send)
        except _PreflightRefusedError as refused:
            problem = ProblemError(
                catalogue.ORIGIN_REFUSED,
                "The origin, the method or a header is not allowed.",
                headers={"Vary": refused.vary},
            )
            await respond(Request(scope), problem)(scope, receive, send)

    def preflight_response(self, request_headers: Headers) -> Response:
        """The answer to a browser that asks first; a refusal is a problem, not plain text."""
        answer = super().preflight_response(request_headers)
        if answer.status_code != 200:
            raise _PreflightRefusedError(answer.headers["vary"])
        return answer


def may_connect(headers: Headers, origins: Sequence[str]) -> bool:
    """Whether a WebSocket is asked for by a page of these origins or of ours, or by no page.

    Browsers ask nobody beforehand whether a page may open one, and let it read what comes: the
    origin, which no page can change, is all there is to judge by.

    Args:
        origins: as browsers send them.
    """
    origin = headers.get("origin")
    if origin is None or origin in origins:
        return True
    scheme, _, host = origin.partition("://")
    usual = {"http": ":80", "https": ":443"}.get(scheme)
    if usual is None or not host:
        return False
    return host == headers.get("host", "").lower().removesuffix(usual)


class _PreflightRefusedError(Exception):
    def __init__(self, vary: str) -> None:
        super().__init__(vary)
        self.vary = vary
