"""One worker: the service on a socket that it is given. ``python -m app.workers.worker``"""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import sys

from app.__main__ import serve
from app.settings import Settings
from app.workers.peer import Supervised


def main(listener: int, channel: int) -> int:
    """Serve until told to stop, or until the supervisor is gone.

    Args:
        listener: descriptor of the bound socket.
        channel: descriptor of this worker's end of the channel.

    Returns:
        The exit status.
    """
    # Ctrl-C reaches every process of a terminal; the supervisor tells its workers itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for descriptor in (listener, channel):
        os.set_inheritable(descriptor, False)
    settings = Settings()

    def stop() -> None:
        """As if told to stop: requests in flight are answered, then the process ends."""
        # Without a supervisor nobody else would end a worker that does not drain.
        asyncio.get_running_loop().call_later(settings.longest_drain, os._exit, 1)
        os.kill(os.getpid(), signal.SIGTERM)

    return serve(
        settings,
        peers=Supervised(socket.socket(fileno=channel), stop),
        sockets=[socket.socket(fileno=listener)],
    )


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
