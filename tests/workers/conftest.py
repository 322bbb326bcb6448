"""Workers in one process: applications that are joined by a real agreement over real channels."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from app.main import create_app
from app.settings import Settings
from app.workers.agreement import Agreement, Member
from app.workers.peer import Supervised
from app.workers.wire import open_channel
from tests.http.conftest import ADMIN_KEY
from tests.http.stores import make_store


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store of the test's own."""
    return make_store(tmp_path / "store")


@pytest.fixture
def admin() -> dict[str, str]:
    """The headers of an administrator."""
    return {"X-Admin-Key": ADMIN_KEY}


@dataclass
class Fleet:
    """Applications over one store, agreeing with each other."""

    store: Path
    agreement: Agreement
    stack: AsyncExitStack
    members: list[Member] = field(default_factory=list)

    async def add(self) -> httpx.AsyncClient:
        """Start one more worker; a client of it.

        Raises:
            RefusedError: it cannot load what the others serve.
        """
        ours, theirs = socket.socketpair()
        channel = await open_channel(ours)
        # Hanging up is what the death of a process looks like from the other end.
        member = Member(channel, len(self.members), channel.close)
        self.members.append(member)
        orphaned = asyncio.Event()
        self.stack.push_async_callback(_hung_up, orphaned)
        listening = asyncio.create_task(member.listen(self.agreement.begin))
        self.stack.push_async_callback(_end, listening)
        peers = Supervised(theirs, orphaned.set)
        app = create_app(Settings(store=self.store, admin_key=ADMIN_KEY), peers)
        starting = asyncio.create_task(self.agreement.admit(member))
        entering = asyncio.create_task(
            self.stack.enter_async_context(app.router.lifespan_context(app))
        )
        try:
            await starting
        except BaseException:
            await _end(entering)
            raise
        await entering
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        client = httpx.AsyncClient(transport=transport, base_url="http://service")
        client.app = app  # type: ignore[attr-defined]
        return await self.stack.enter_async_context(client)


async def _hung_up(orphaned: asyncio.Event) -> None:
    """Return when both ends of a channel are closed: a loop that ends sooner leaves them open."""
    await orphaned.wait()
    await asyncio.sleep(0)
    await asyncio.sleep(0)


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


@asynccontextmanager
async def fleet(store: Path, *, patience: float = 60.0) -> AsyncIterator[Fleet]:
    """No worker yet, over a store."""
    agreement = Agreement(patience=patience, swap_patience=patience)
    async with AsyncExitStack() as stack:
        yield Fleet(store, agreement, stack)
