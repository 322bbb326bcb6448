"""Answers for what nothing else has caught."""

from __future__ import annotations

from contextlib import suppress
from typing import Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api import catalogue
from app.api.problems import answer, from_exception, report_defect

# RFC 6455: the server met a condition that it did not expect.
_DEFECT: Final = 1011


class Defects:
    """Answers what nothing else has caught, as long as no answer has begun."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "lifespan":
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
            if begun and scope["type"] == "http":
                # Half an answer cannot be taken back: the server breaks the connection off.
                raise
            state = scope["state"]
            report_defect(error, state["request_id"])
            if begun:
                state["record"].outcome = catalogue.INTERNAL_ERROR.slug
                with suppress(OSError):  # the client has gone
                    await send({"type": "websocket.close", "code": _DEFECT})
            else:
                await answer(from_exception(error), scope, receive, send)
