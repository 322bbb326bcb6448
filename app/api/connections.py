"""What the server lets one connection cost: a bounded head, bounded waiting, answers in order.

uvicorn leaves all of this to a proxy: it waits for ever for a head or for a client that does not
read, keeps a head of any size, queues pipelined requests without end, and answers what is no HTTP
in plain text, before the answers that are still due on the connection.
"""

from __future__ import annotations

import asyncio
import logging
import uuid
from itertools import chain
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import (
    STATUS_LINE,
    HttpToolsProtocol,
    RequestResponseCycle,
)

from app.api import catalogue
from app.api.catalogue import ProblemType
from app.api.problems import MEDIA_TYPE, ProblemError

MAX_HEAD: Final = 64 * 1024
"""Bytes of a request line with its headers, or of what follows a chunked body."""

STREAM: Final = b"/stream"
"""Where WebSockets are; who asks for one elsewhere is answered in HTTP."""

MAX_PIPELINED: Final = 64
"""Requests of one connection that may wait for the answer to an earlier one."""

_access = logging.getLogger("app.access")

_DETAILS: Final = {
    catalogue.BAD_REQUEST: "This is no request that the service can read.",
    catalogue.HEAD_TOO_LARGE: f"The head must not be larger than {MAX_HEAD} bytes.",
    catalogue.REQUEST_TIMEOUT: "The head of the request did not come in time.",
}


class _RefusedError(Exception):
    """Stops the parser in the middle of what was received."""


class GuardedProtocol(HttpToolsProtocol):
    """One connection, bounded.

    A subclass (`guarded`) sets `patience`, in seconds: how long a client may take to send a head,
    and to take in an answer. Bodies are bounded where they are read.
    """

    patience: float

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._waiting: asyncio.TimerHandle | None = None
        self._unread: asyncio.TimerHandle | None = None
        # Bytes since the parser last told of a whole head or of a part of a body.
        self._untold = 0
        self._in_head = False
        self._switches = False
        self._running: RequestResponseCycle | None = None
        self._refusal: ProblemType | None = None

    # -- waiting --------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first head."""
        super().connection_made(transport)
        self._await_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing any more."""
        super().connection_lost(exc)
        self._head_came()
        self.resume_writing()
        self.pipeline.clear()

    def _await_head(self) -> None:
        if self._waiting is None:
            self._waiting = self.loop.call_later(self.patience, self._head_is_late)

    def _head_came(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _head_is_late(self) -> None:
        self._waiting = None
        if self.transport.is_closing():
            return
        if self._in_head:
            self._refuse(catalogue.REQUEST_TIMEOUT)
        else:
            # Nothing has been asked, so nothing is answered.
            self._close()

    def pause_writing(self) -> None:
        """The client reads more slowly than it is answered: not for ever."""
        super().pause_writing()
        if self._unread is None:
            self._unread = self.loop.call_later(self.patience, self.transport.abort)

    def resume_writing(self) -> None:
        """The client has read on."""
        super().resume_writing()
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def timeout_keep_alive_handler(self) -> None:
        """Close an idle connection; one that has left its answer unread cannot be flushed."""
        self._close()

    def _close(self) -> None:
        if self.transport.get_write_buffer_size():
            self.transport.abort()
        else:
            self.transport.close()

    # -- parsing --------------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        """Parse what came; nothing more after a refusal."""
        if self._refusal is not None:
            return
        self._untold += len(data)
        super().data_received(data)
        if self._untold > MAX_HEAD and self._refusal is None:
            self._refuse(catalogue.HEAD_TOO_LARGE)
        elif self in self.connections and (self._newest is None or self.cycle.response_complete):
            # What came starts no request yet, or belongs to one that is answered: an empty line now
            # and then must not keep a connection for good.
            self._await_head()

    def on_message_begin(self) -> None:
        """A request begins."""
        super().on_message_begin()
        self._in_head = True

    def on_headers_complete(self) -> None:
        """The head is there: start the request, or let it wait for the one before."""
        self._untold = 0
        # Each field came with a colon, a space and an end of line.
        size = len(self.url) + sum(map(len, chain.from_iterable(self.headers)))
        if size + 4 * len(self.headers) > MAX_HEAD:
            self._refuse(catalogue.HEAD_TOO_LARGE)
            raise _RefusedError
        if len(self.pipeline) >= MAX_PIPELINED or self._has_lost_body():
            self._refuse(catalogue.BAD_REQUEST)
            raise _RefusedError
        # Asked again and again from here on, and must not change with what is answered.
        self._switches = self._may_switch()
        super().on_headers_complete()
        self._in_head = False
        self._head_came()

    def _has_lost_body(self) -> bool:
        """Whether the body would be taken for another protocol, and what follows for a request."""
        return self.parser.should_upgrade() and any(
            name == b"transfer-encoding" or (name == b"content-length" and value != b"0")
            for name, value in self.headers
        )

    def on_body(self, body: bytes) -> None:
        """Part of a body."""
        self._untold = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """The request is there."""
        self._untold = 0
        super().on_message_complete()

    def _may_switch(self) -> bool:
        """Whether the request asks for a WebSocket where there is one, and owes it no answer."""
        return (
            self.url.partition(b"?")[0] == STREAM and self._owes_nothing() and self._unread is None
        )

    def _should_upgrade(self) -> bool:
        return self._switches and super()._should_upgrade()

    def _unsupported_upgrade_warning(self) -> None:
        """Who asks for another protocol is answered in HTTP: nothing to warn of."""

    def handle_websocket_upgrade(self) -> None:
        """Hand the connection over to `app.api.sockets`."""
        self._head_came()
        super().handle_websocket_upgrade()

    # -- refusing -------------------------------------------------------------------------------

    def send_400_response(self, msg: str) -> None:
        """What came is no HTTP."""
        self._refuse(catalogue.BAD_REQUEST)

    def _refuse(self, kind: ProblemType) -> None:
        """Answer with a problem, after the answers that are due, and close."""
        if self._refusal is not None:
            return
        self._refusal = kind
        self._head_came()
        cycle = self._newest
        if not self._in_head and cycle is not None and cycle.more_body:
            # A body that broke: whoever reads it must not wait for the rest.
            if self.pipeline and self.pipeline[0][0] is cycle:
                self.pipeline.popleft()
            elif not cycle.response_complete:
                cycle.disconnected = True
                cycle.message_event.set()
                self._running = None
                if cycle.response_started:
                    self.transport.abort()
                    return
        if self._owes_nothing():
            self._send_refusal(kind)

    @property
    def _newest(self) -> RequestResponseCycle | None:
        """The last request whose head came; uvicorn's own type forgets that there may be none."""
        return self.cycle

    def _owes_nothing(self) -> bool:
        """Whether every request before has its answer."""
        return self._running is None and not self.pipeline

    def _send_refusal(self, kind: ProblemType) -> None:
        request_id = str(uuid.uuid4())
        problem = ProblemError(kind, _DETAILS[kind]).describe(request_id)
        body = problem.model_dump_json(exclude_none=True).encode()
        headers = (
            f"content-type: {MEDIA_TYPE}\r\ncontent-length: {len(body)}\r\n"
            f"x-request-id: {request_id}\r\nconnection: close\r\n\r\n"
        )
        self.transport.write(STATUS_LINE[kind.status] + headers.encode() + body)
        self.transport.close()
        _access.info(
            "refused %d", kind.status, extra={"request_id": request_id, "status": kind.status}
        )

    # -- order ----------------------------------------------------------------------------------

    def _start_asgi_task(self, cycle: RequestResponseCycle, app: Any) -> None:
        self._running = cycle
        super()._start_asgi_task(cycle, app)

    def on_response_complete(self) -> None:
        """Start the next request, or give the refusal that had to wait."""
        self._running = None
        super().on_response_complete()
        if self._refusal is not None and self._owes_nothing() and not self.transport.is_closing():
            self._unset_keepalive_if_required()
            self._send_refusal(self._refusal)


def guarded(patience: float) -> type[GuardedProtocol]:
    """The protocol for uvicorn, which makes its instances itself.

    Args:
        patience: see `GuardedProtocol`.
    """
    return type("GuardedProtocol", (GuardedProtocol,), {"patience": patience})
