"""Headers that tell browsers what answers are."""

from __future__ import annotations

from typing import Final

from starlette.types import ASGIApp, Message, Receive, Scope, Send


class SafeHeaders:
    """Tells browsers to take answers for what they are and to keep none of what was computed.

    What an answer says for itself stands: pages have a policy of their own, and files, which have
    an entity tag, may be kept.
    """

    _ALWAYS: Final = (
        (b"x-content-type-options", b"nosniff"),
        (b"referrer-policy", b"no-referrer"),
    )
    _POLICY: Final = (b"content-security-policy", b"default-src 'none'; frame-ancestors 'none'")
    _NOT_KEPT: Final = (b"cache-control", b"no-store")

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = [*message.get("headers", ()), *self._ALWAYS]
                names = {name for name, _ in headers}
                if b"content-security-policy" not in names:
                    headers.append(self._POLICY)
                if not names & {b"cache-control", b"etag"}:
                    headers.append(self._NOT_KEPT)
                message["headers"] = headers
            await send(message)

        await self.app(scope, receive, send_with_headers)
