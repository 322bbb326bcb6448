"""Fixtures of the tests over HTTP."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import httpx
import pytest

from tests.services import ADMIN_KEY, serve


@pytest.fixture
async def own(store: Path) -> AsyncIterator[httpx.AsyncClient]:
    """An administrator's client of a service with the store of this test."""
    async with serve(store) as client:
        client.headers["X-Admin-Key"] = ADMIN_KEY
        yield client
