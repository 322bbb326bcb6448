"""What the supervisor and a worker say to each other: JSON lines over a socket pair.

A worker starts with `hello`. Whoever is told to `prepare` a generation answers `prepared` or
`refused`; then comes `commit`, answered by `committed`, or `abort`. A worker's first commit is what
lets it accept connections.

A worker that wants to change the models says `begin` and waits for `granted`. It says `propose`
once it has made ready to serve the new generation itself, and hears `agreed` when all others have,
or `disagreed`. After its `commit` the supervisor has everybody commit and says `done`; after its
`abort` everybody forgets.
"""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Literal

# A generation takes some hundred bytes a version, and a reason in words for each one refused.
_LONGEST = 2**24

Kind = Literal[
    "hello",
    "prepare",
    "prepared",
    "refused",
    "commit",
    "committed",
    "abort",
    "begin",
    "granted",
    "propose",
    "agreed",
    "disagreed",
    "done",
]


@dataclass(frozen=True, slots=True)
class Message:
    """One line.

    Attributes:
        kind: see above.
        change: the change that it belongs to, numbered by who began to speak of it: an answer
            that comes too late shows by its number.
        generation: what to serve, as text that the supervisor only compares.
        failures: why not, each with a `subject`, a `reason` and a `detail`.
    """

    kind: Kind
    change: int = 0
    generation: str | None = None
    failures: tuple[Mapping[str, str], ...] = ()


class Channel:
    """One end of the line between the supervisor and a worker; see `open_channel`."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer

    def send(self, message: Message) -> None:
        """Send, in order. What is sent to an end that is gone is lost; `receive` tells."""
        if not self._writer.is_closing():
            self._writer.write(json.dumps(asdict(message)).encode() + b"\n")

    async def receive(self) -> Message | None:
        """The next message; None when the other end is gone."""
        try:
            line = await self._reader.readline()
        except ConnectionError:
            return None
        if not line.endswith(b"\n"):
            return None
        fields = json.loads(line)
        return Message(**fields | {"failures": tuple(fields["failures"])})

    def close(self) -> None:
        """Hang up."""
        self._writer.close()


async def open_channel(end: socket.socket) -> Channel:
    """A channel over one end of a socket pair."""
    return Channel(*await asyncio.open_connection(sock=end, limit=_LONGEST))
