"""Middleware around Ray Serve, selected by ``RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH``."""

from __future__ import annotations

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_REQUEST_ID = b"x-request-id"
_WATCH = b"x-request-disconnect-disabled"
_TIMEOUT = b"x-request-timeout-seconds"


class Unchanged:
    """Pass requests and answers of the service through Ray Serve unchanged.

    Ray Serve would read all messages of a client into an unlimited queue, to notice that the client
    disconnects. The service checks this itself, and reads a body only as fast as it can process
    it. Ray Serve also adds a second request id to each answer. Clients cannot change these
    settings by headers.

    Args:
        app: the application of Ray Serve, which contains the service.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = [pair for pair in scope["headers"] if pair[0] not in (_WATCH, _TIMEOUT)]
        scope["headers"] = [*headers, (_WATCH, b"?1")]

        async def send_one_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                # The id of the service comes first.
                names = [name for name, _ in message["headers"]]
                if names.count(_REQUEST_ID) > 1:
                    del message["headers"][len(names) - 1 - names[::-1].index(_REQUEST_ID)]
            await send(message)

        await self._app(scope, receive, send_one_id)


def middlewares() -> list[Middleware]:
    """Return the middlewares for Ray Serve."""
    return [Middleware(Unchanged)]
