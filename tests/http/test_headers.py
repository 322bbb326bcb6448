"""The security and cache headers of every answer."""

from __future__ import annotations

import re
from typing import Any

import httpx
import pytest

from tests.services import LiveService, Replace, defect

NOTHING = "default-src 'none'; frame-ancestors 'none'"
COMPUTED = [
    ("POST", "/relations", {"objects": ["bed"]}),
    ("POST", "/missing/batch", {"scenes": [{"objects": ["bed"]}]}),
    ("POST", "/missing", {"objects": ["bed"]}),  # status 500
    ("GET", "/models", None),
    ("GET", "/models/default/vocabulary", None),
    ("GET", "/health/live", None),
    ("GET", "/openapi.json", None),
    ("POST", "/relations", {"objects": []}),
    ("POST", "/models/refresh", None),
    ("GET", "/nowhere", None),
    ("GET", "/static/nowhere", None),
    ("DELETE", "/relations", None),
]


def check(response: httpx.Response) -> None:
    """What holds for every answer."""
    assert response.headers["x-content-type-options"] == "nosniff"
    assert response.headers["referrer-policy"] == "no-referrer"
    assert "frame-ancestors 'none'" in response.headers["content-security-policy"]
    assert "server" not in response.headers
    assert "x-powered-by" not in response.headers
    # One of each: a browser joins two policies, and two cache rules contradict each other.
    names = [name for name, _ in response.headers.raw]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(("method", "path", "body"), COMPUTED)
async def test_computed_answers_are_not_cached_and_load_nothing(
    client: httpx.AsyncClient, replace: Replace, method: str, path: str, body: Any
) -> None:
    replace("missing", defect)
    response = await client.request(method, path, json=body)
    check(response)
    assert response.headers["cache-control"] == "no-store"
    assert response.headers["content-security-policy"] == NOTHING


@pytest.mark.parametrize("path", ["/", "/docs", "/redoc", "/problems", "/problems/not-json"])
async def test_pages_keep_their_own_policy(client: httpx.AsyncClient, path: str) -> None:
    response = await client.get(path)
    check(response)
    policy = response.headers["content-security-policy"]
    directives = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert directives["default-src"] == "'none'"
    assert directives["script-src"] == "'self'"
    assert not re.search(r"https?:|\*", policy)
    assert path != "/" or "unsafe" not in policy


@pytest.mark.system
def test_the_server_does_not_name_itself(live: LiveService) -> None:
    for path in ("health/live", "docs", "nowhere", "static/pages.css", "docs/swagger-ui-bundle.js"):
        check(live.client.get(f"/{path}"))
