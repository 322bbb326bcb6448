"""The admin key: asked for before anything of the request is read."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, Final

from fastapi import Security
from fastapi.security import APIKeyHeader, HTTPBearer
from starlette.requests import Request
from starlette.responses import Response

from app.api import catalogue, keys
from app.api.body import JSONRoute
from app.api.problems import ProblemError
from app.settings import Settings

# For the documentation alone, where they make the routes usable: dependencies are resolved after
# the body has been read, and a stranger's body is not to be read.
SCHEMES: Final = [
    Security(APIKeyHeader(name=keys.ADMIN_KEY, scheme_name="admin-key", auto_error=False)),
    Security(HTTPBearer(scheme_name="admin-key-as-bearer-token", auto_error=False)),
]


def check(request: Request) -> None:
    """Return if the request carries the admin key.

    Raises:
        ProblemError: of kind `catalogue.UNAUTHORIZED`, also where no key is configured.
    """
    settings: Settings = request.app.state.settings
    if not keys.carries(request.headers, keys.ADMIN_KEY, settings.admin_key):
        raise ProblemError(
            catalogue.UNAUTHORIZED,
            "This route needs the service's admin key.",
            headers={"WWW-Authenticate": "Bearer"},
        )


class AdminRoute(JSONRoute):
    """A route for those who have the admin key."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """The handler behind the check of the key."""
        handle = super().get_route_handler()

        async def check_first(request: Request) -> Response:
            check(request)
            return await handle(request)

        return check_first
