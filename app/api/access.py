"""Who may use the service: the checks of the Host header and of the API key."""

import hmac
import re
from typing import Final

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from app import errors
from app.api.problems import answer

API_KEY: Final = "X-API-Key"
TIMEOUT_HEADER: Final = "X-Request-Timeout-Ms"

HEALTH: Final = frozenset(("/health/live", "/health/ready"))
"""Routes of health checks. They accept every Host header and take no turn."""

# Paths that need no API key. Orchestrators send health checks without credentials. The HTML pages
# contain no private data. docs/security.md gives the reasons.
OPEN_ROUTES: Final = HEALTH | {"/", "/docs", "/redoc", "/openapi.json", "/problems"}
_OPEN_FOLDERS: Final = ("/docs/", "/redoc/", "/static/", "/problems/")

_HOST: Final = re.compile(rb"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")
_ADDRESS: Final = re.compile(rb"\[.+\]|[0-9]{1,3}(\.[0-9]{1,3}){3}")


def route_path(scope: Scope) -> str:
    """Return the path of a request below the root path of the service."""
    path: str = scope["path"]
    return path.removeprefix(scope.get("root_path", ""))


class HostCheck:
    """Refuse requests whose Host header does not name this service.

    This check prevents DNS rebinding, where an attacker points the host name of a web page at this
    machine. That attack needs a name, so every IP address is accepted.

    Args:
        names: accepted host names, in lower case, without ports.
    """

    def __init__(self, app: ASGIApp, names: frozenset[str]) -> None:
        self._app = app
        self._names = frozenset(name.encode("ascii") for name in names)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass an accepted request on, or answer with status 421."""
        hosts = [value for name, value in scope["headers"] if name == b"host"]
        host = _HOST.fullmatch(hosts[0].lower()) if len(hosts) == 1 else None
        is_named = host is not None and (host[1] in self._names or _ADDRESS.fullmatch(host[1]))
        if is_named or route_path(scope) in HEALTH:
            await self._app(scope, receive, send)
            return
        detail = (
            "The service does not know the name in the Host header. Use its IP address, or list "
            "the name in SCENE_ALLOWED_HOSTS (docs/network.md)."
        )
        await answer(errors.HostRefusedError(detail), scope, receive, send)


class KeyCheck:
    """Refuse requests without the API key, except for open routes."""

    def __init__(self, app: ASGIApp, key: SecretStr) -> None:
        self._app, self._key = app, key.get_secret_value().encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on.

        Raises:
            UnauthorizedError: the request lacks the key.
        """
        path, headers = route_path(scope), Headers(scope=scope)
        scheme, _, token = headers.get("authorization", "").partition(" ")
        key = headers.get(API_KEY) or (token.strip() if scheme.lower() == "bearer" else "")
        # The comparison takes constant time. Otherwise the response time would show how many
        # characters match.
        has_key = hmac.compare_digest(key.encode(), self._key)
        if not (has_key or path in OPEN_ROUTES or path.startswith(_OPEN_FOLDERS)):
            raise errors.UnauthorizedError("This service needs its API key.")
        await self._app(scope, receive, send)
