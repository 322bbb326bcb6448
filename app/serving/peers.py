"""Whom a change of models has to be agreed on with: nobody, or the other workers."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from typing import Protocol

from app.serving.generation import Generation


class Participant(Protocol):
    """What changes its models in two steps, of which only the first can fail."""

    async def prepare(self, generation: Generation | None) -> Generation:
        """Make ready to serve exactly this, or with None what the store holds; serve on meanwhile.

        Returns:
            What was made ready.

        Raises:
            RefreshRefusedError: it cannot be served.
        """

    def commit(self) -> None:
        """Serve what was made ready."""

    def abort(self) -> None:
        """Forget what was made ready, if anything was."""


class Change(Protocol):
    """A change that is under way; leaving it without `commit` means that nothing changes."""

    async def agree(self, generation: Generation) -> None:
        """Return when everybody else has made ready to serve this.

        Raises:
            RefreshRefusedError: somebody cannot.
        """

    async def commit(self) -> None:
        """Return when everybody serves it, this process too."""


class Peers(Protocol):
    """The processes that serve the same models at one address."""

    async def join(self, participant: Participant) -> None:
        """Let ``participant`` serve what the others do, from now on with each of their changes.

        Raises:
            ConnectionError: the others are gone.
        """

    def change(self) -> AbstractAsyncContextManager[Change]:
        """A change to be agreed on; one at a time, so this waits for the one under way."""


class Alone:
    """No other process: every change is agreed on at once."""

    def __init__(self) -> None:
        self._changing = asyncio.Lock()
        self._participant: Participant | None = None

    async def join(self, participant: Participant) -> None:
        """Let ``participant`` serve what the store holds."""
        self._participant = participant
        await participant.prepare(None)
        participant.commit()

    @asynccontextmanager
    async def change(self) -> AsyncIterator[Change]:
        """See `Peers.change`."""
        async with self._changing:
            try:
                yield self
            finally:
                if self._participant is not None:
                    self._participant.abort()  # after a commit there is nothing to forget

    async def agree(self, generation: Generation) -> None:
        """Nobody objects."""

    async def commit(self) -> None:
        """See `Change.commit`."""
        if self._participant is not None:
            self._participant.commit()
