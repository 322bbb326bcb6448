"""The bytes that requests and answers hold in memory, and the reading of bodies."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from starlette.types import Receive

from app import errors
from app.serving.admission import SHARE
from app.settings import Settings

SMALL: Final = 16 * 1024
"""Maximum size in bytes of a body that the event loop parses, in less than a millisecond.

The service accepts such a body if it arrives in one piece, also when other bodies fill the budget.
"""


def too_large(limit: int) -> errors.BodyTooLargeError:
    """Return the error for a body of more than ``limit`` bytes."""
    return errors.BodyTooLargeError(f"The body must not be larger than {limit} bytes.")


class Bodies:
    """The bodies of all requests and answers in progress. Their total size is bounded.

    One client holds at most a quarter of the budget, or a single body.

    Attributes:
        held: total size of the bodies in bytes.
        patience: maximum time in seconds to receive a body or to send an answer.
    """

    def __init__(self, settings: Settings) -> None:
        self._budget = settings.held_body_bytes
        self.patience = settings.client_timeout
        self._of_clients: dict[str, int] = {}
        self.held = 0

    @contextmanager
    def hold(self, client: str, size: int) -> Iterator[None]:
        """Count a large answer of a client until the ``with`` block ends.

        Raises:
            BodiesFullError: the budget is full.
        """
        self._add(client, size)
        try:
            self._check(client, size)
            yield
        finally:
            self.release(client, size)

    def release(self, client: str, size: int) -> None:
        """Stop counting a body of a client."""
        self._add(client, -size)

    async def read(self, receive: Receive, client: str, limit: int) -> bytes:
        """Read a whole body of at most ``limit`` bytes. The caller must `release` it.

        Raises:
            ServiceError: the body is too large, too slow or incomplete, or the budget is full.
        """
        body: bytes | bytearray = b""
        try:
            async with asyncio.timeout(self.patience):
                more = True
                while more:
                    message = await receive()
                    if message["type"] != "http.request":
                        detail = "The connection closed before the body was complete."
                        raise errors.BadRequestError(detail)
                    part, more = message.get("body", b""), message.get("more_body", False)
                    is_whole = not (more or body)
                    self._add(client, len(part))
                    if is_whole:
                        body = part
                    else:
                        body = bytearray(body) if isinstance(body, bytes) else body
                        body += part
                    if len(body) > limit:
                        raise too_large(limit)
                    if not (is_whole and len(body) <= SMALL):
                        self._check(client, len(body))
        except BaseException as error:
            self.release(client, len(body))
            if isinstance(error, TimeoutError):
                detail = f"The body did not arrive within {self.patience:g} seconds."
                raise errors.RequestTimeoutError(detail) from None
            raise
        return bytes(body)

    def _add(self, client: str, size: int) -> None:
        self.held += size
        of_client = self._of_clients.pop(client, 0) + size
        if of_client:
            self._of_clients[client] = of_client

    def _check(self, client: str, size: int) -> None:
        share = max(self._budget // SHARE, size)
        if self.held > self._budget or self._of_clients.get(client, 0) > share:
            detail = (
                f"All bodies in progress exceed {self._budget} bytes together, or those of this "
                f"client {share} bytes."
            )
            raise errors.BodiesFullError(detail)
