"""The door of a service that has an API key."""

from __future__ import annotations

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from app.api import catalogue, keys
from app.api.problems import ProblemError, answer


class KeyGuard:
    """Lets through what is open, and who carries the API key or the admin key.

    The admin routes ask for the admin key once more: here it only opens the door.
    """

    def __init__(self, app: ASGIApp, *, api_key: SecretStr, admin_key: SecretStr | None) -> None:
        self.app = app
        self.api_key = api_key
        self.admin_key = admin_key

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] == "lifespan" or keys.is_open(scope) or self._may_enter(scope):
            await self.app(scope, receive, send)
        else:
            problem = ProblemError(
                catalogue.UNAUTHORIZED,
                "This service needs its API key, or for administration its admin key.",
                headers={"WWW-Authenticate": "Bearer"},
            )
            await answer(problem, scope, receive, send)

    def _may_enter(self, scope: Scope) -> bool:
        headers = Headers(scope=scope)
        asks = keys.carries(headers, keys.API_KEY, self.api_key)
        administers = keys.carries(headers, keys.ADMIN_KEY, self.admin_key)
        return asks or administers
