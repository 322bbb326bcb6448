"""What the server lets one WebSocket cost, as `app.api.connections` says it of HTTP.

uvicorn waits for ever for a client that does not read, keeps as many pieces of a message as a
client cares to send, answers pings that nobody reads, and refuses a handshake in plain text.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import uuid
from http import HTTPStatus
from typing import Any, Final

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame
from websockets.http11 import Response
from websockets.server import ServerProtocol

from app.api import catalogue
from app.api.problems import MEDIA_TYPE, ProblemError

MAX_FRAGMENTS: Final = 1024
"""Pieces that one message may come in; each costs memory, an empty one as well."""

# Bytes that the system may hold for a client that does not read. More would be answers of the past
# that it has to read before the newest.
_SEND_BUFFER: Final = 32 * 1024
_POLICY: Final = 1008
_NO_TEXT: Final = 1007

_access = logging.getLogger("app.access")


class Handshakes(ServerProtocol):
    """Refuses a handshake with a problem."""

    def reject(self, status: HTTPStatus | int, text: str) -> Response:
        """The refusal, which repeats nothing of what the client sent."""
        defect = status == HTTPStatus.INTERNAL_SERVER_ERROR
        kind = catalogue.INTERNAL_ERROR if defect else catalogue.BAD_REQUEST
        detail = "The service failed." if defect else "This is no handshake of a WebSocket."
        request_id = str(uuid.uuid4())
        problem = ProblemError(kind, detail).describe(request_id)
        if not defect:
            fields = {"request_id": request_id, "status": kind.status}
            _access.info("refused %d", kind.status, extra=fields)
        response = super().reject(kind.status, problem.model_dump_json(exclude_none=True))
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = MEDIA_TYPE
        response.headers["X-Request-Id"] = request_id
        return response


class GuardedSocket(WebSocketsSansIOProtocol):
    """One WebSocket, bounded.

    A subclass (`guarded`) sets `patience`: seconds that a client may take to read what it is sent,
    and to end when the service has ended.
    """

    patience: float

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.conn = Handshakes(max_size=self.config.ws_max_size)
        self._unread: asyncio.TimerHandle | None = None
        self._lingering: asyncio.TimerHandle | None = None
        self._parted = False

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Let little be on its way to a client that does not read."""
        super().connection_made(transport)
        self.transport.set_write_buffer_limits(high=0)
        connection = self.transport.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing any more."""
        super().connection_lost(exc)
        self._has_read()
        if self._lingering is not None:
            self._lingering.cancel()

    def pause_writing(self) -> None:
        """The client reads more slowly than it is answered: not for ever."""
        super().pause_writing()
        if self._unread is None:
            self._unread = self.loop.call_later(self.patience, self.transport.abort)

    def resume_writing(self) -> None:
        """The client has read on."""
        super().resume_writing()
        self._has_read()

    def _has_read(self) -> None:
        if self._unread is not None:
            self._unread.cancel()
            self._unread = None

    def on_task_complete(self, task: asyncio.Task[None]) -> None:
        """The service has said its farewell: the client has some time for its own."""
        super().on_task_complete(task)
        if not self.disconnected:
            self._lingering = self.loop.call_later(self.patience, self.transport.abort)

    def shutdown(self) -> None:
        """The server ends. An open stream has been told, and takes its leave itself."""
        if self.close_sent or not self.handshake_complete:
            super().shutdown()

    def handle_ping(self) -> None:
        """Answer, unless the client reads no answers."""
        if self._parted:
            return
        if self._unread is None:
            super().handle_ping()
        else:
            self.conn.data_to_send()

    def handle_cont(self, event: Frame) -> None:
        """A further piece of a message."""
        if self.close_sent:
            return
        if len(self.frames) < MAX_FRAGMENTS:
            super().handle_cont(event)
        else:
            self._fail(_POLICY, "too many fragments")

    def send_receive_event_to_app(self) -> None:
        """A whole message; uvicorn would write a traceback about one that is no text."""
        if self.curr_msg_data_type == "text" and not _is_text(b"".join(self.frames)):
            self._fail(_NO_TEXT, "")
        else:
            super().send_receive_event_to_app()

    def handle_parser_exception(self) -> None:
        """What came is too long, or no WebSocket's."""
        self._part()

    def _fail(self, code: int, reason: str) -> None:
        self.frames = []
        self.conn.fail(code, reason)
        self._part()

    def _part(self) -> None:
        """Say why, and let the client read it: its messages are discarded until it has.

        A socket that is closed while there is something to be read takes back what it sent.
        """
        close = self.conn.close_sent
        if self._parted or close is None:
            return
        self._parted = True
        self.transport.write(b"".join(self.conn.data_to_send()))
        if not self.close_sent:
            self.queue.put_nowait(
                {"type": "websocket.disconnect", "code": close.code, "reason": close.reason}
            )
        self.close_sent = self.disconnected = True
        if not self.transport.can_write_eof():
            self.transport.close()
            return
        self.transport.write_eof()
        if self.close_timer is None:
            self.close_timer = self.loop.call_later(self.patience, self.transport.abort)


def _is_text(data: bytes) -> bool:
    try:
        data.decode()
    except UnicodeDecodeError:
        return False
    return True


def guarded(patience: float) -> type[GuardedSocket]:
    """The protocol for uvicorn, which makes its instances itself.

    Args:
        patience: see `GuardedSocket`.
    """
    return type("GuardedSocket", (GuardedSocket,), {"patience": patience})
