"""Answers for what nothing else has caught."""

from __future__ import annotations

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.problems import from_exception, report_defect, respond


class Defects:
    """Answers what nothing else has caught, as long as no answer has begun."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        begun = False

        async def send_and_note(message: Message) -> None:
            nonlocal begun
            begun = True
            await send(message)

        try:
            await self.app(scope, receive, send_and_note)
        except Exception as error:
            if begun:
                # Half an answer cannot be taken back: the server breaks the connection off.
                raise
            request = Request(scope)
            report_defect(error, request.state.request_id)
            await respond(request, from_exception(error))(scope, receive, send)
