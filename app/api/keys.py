"""Which keys a request carries, and what may be had without one.

docs/security.md says why these routes are open.
"""

from __future__ import annotations

import hmac
from typing import Final

from pydantic import SecretStr
from starlette.datastructures import Headers
from starlette.types import Scope

API_KEY: Final = "X-API-Key"
ADMIN_KEY: Final = "X-Admin-Key"

# Orchestrators ask for health without credentials and learn yes or no from it; the pages are the
# same for every installation and hold nothing of this one. Whatever is not listed needs a key.
OPEN_ROUTES: Final = frozenset(
    {
        "/health/live",
        "/health/ready",
        "/v2/health/live",
        "/v2/health/ready",
        "/",
        "/docs",
        "/redoc",
        "/openapi.json",
        "/problems",
    }
)
OPEN_FOLDERS: Final = ("/docs/", "/redoc/", "/static/", "/problems/")


def is_open(scope: Scope) -> bool:
    """Whether a connection asks for something that needs no key."""
    path: str = scope["path"].removeprefix(scope.get("root_path", ""))
    return path in OPEN_ROUTES or path.startswith(OPEN_FOLDERS)


def carries(headers: Headers, name: str, expected: SecretStr | None) -> bool:
    """Whether a key stands in its own header or, without that, as a bearer token.

    Args:
        headers: of the request.
        name: the key's own header.
        expected: the key; no request carries one that is not configured.
    """
    scheme, _, token = headers.get("authorization", "").partition(" ")
    given = headers.get(name) or (token.strip() if scheme.lower() == "bearer" else "")
    secret = expected.get_secret_value() if expected else ""
    # In constant time, and first: neither the key nor whether there is one shows in the clock.
    equal = hmac.compare_digest(given.encode(), secret.encode())
    return equal and bool(secret)
