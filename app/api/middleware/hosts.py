"""Under which names the service answers.

A page whose name is made to point at this machine after it was loaded (DNS rebinding) is of the
service's own origin to its browser. The Host header still holds the page's name.
"""

from __future__ import annotations

import re
from typing import Final

from starlette.types import ASGIApp, Receive, Scope, Send

from app.api import catalogue
from app.api.problems import ProblemError, answer

_HOST: Final = re.compile(rb"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:[0-9]{1,5})?")

HEALTH: Final = ("/health/live", "/health/ready")
"""Ends of paths that answer under every name.

Orchestrators and load balancers ask by the address of a replica, and learn only yes or no.
"""


class HostGuard:
    """Refuses requests and handshakes whose Host header names another machine.

    Args:
        app: the application.
        hosts: accepted names, in lower case and without ports.
    """

    def __init__(self, app: ASGIApp, *, hosts: frozenset[str]) -> None:
        self.app = app
        self.hosts = frozenset(name.encode("ascii") for name in hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if (
            scope["type"] == "lifespan"
            or scope["path"].endswith(HEALTH)
            or self._is_accepted(scope)
        ):
            await self.app(scope, receive, send)
            return
        problem = ProblemError(
            catalogue.HOST_REFUSED, "SCENE_ALLOWED_HOSTS does not list the name in the Host header."
        )
        await answer(problem, scope, receive, send)

    def _is_accepted(self, scope: Scope) -> bool:
        given = [value for name, value in scope["headers"] if name == b"host"]
        if len(given) != 1:
            return False
        host = _HOST.fullmatch(given[0].lower())
        return host is not None and host[1] in self.hosts
