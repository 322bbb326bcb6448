"""``python -m app``: serve with the settings of the environment."""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import socket
import sys
from contextlib import suppress
from time import monotonic

from pydantic import ValidationError

from app.settings import Settings


def main() -> int:
    """Serve until stopped.

    Returns:
        The exit status: 2 where the settings make no sense.
    """
    began = monotonic()
    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors(include_url=False, include_input=False):
            variable = "SCENE_" + "_".join(str(part) for part in fault["loc"]).upper()
            sys.stderr.write(f"{variable}: {fault['msg'].removeprefix('Value error, ')}\n")
        return 2
    return serve(settings, began)


# Threshold of the garbage collector's youngest generation. An answer has some two hundred
# containers, all freed by reference counts. The default of 700 costs 4 to 8 % of a request's time.
_YOUNG = 10_000


# See mallopt(3).
_M_MMAP_THRESHOLD, _LARGE = -3, 128 * 1024


def _give_back_what_is_large() -> None:
    """Let the C library return blocks of 128 KiB and more to the system as soon as they are freed.

    It does so at first, and would for ever larger ones alone once such were freed: bodies of
    megabytes would leave 20 MB of holes.
    """
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(_M_MMAP_THRESHOLD, _LARGE)


def _bind(host: str, port: int, send_timeout: float) -> list[socket.socket]:
    """Sockets for all addresses of a host; a connection is refused until the server listens.

    Args:
        send_timeout: seconds after which Linux ends a connection whose client acknowledges no
            bytes. On other systems only a proxy bounds that.

    Raises:
        OSError: the host has no usable address, or the port is not free.
    """
    bound: list[socket.socket] = []
    problem: OSError | None = None
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    for family, kind, protocol, _, address in dict.fromkeys(found):
        try:
            place = socket.socket(family, kind, protocol)
            place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                place.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # connections inherit it
                milliseconds = int(send_timeout * 1e3)
                place.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, milliseconds)
            place.bind(address)
        except OSError as error:
            # A name such as localhost may have an address of a kind that the machine lacks.
            if error.errno not in {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT}:
                raise
            problem = error
        else:
            bound.append(place)
    if problem is not None and not bound:
        raise problem
    return bound


def _refuse_address(settings: Settings, error: OSError) -> int:
    """Say why the service cannot listen where it should; the exit status."""
    place = f"{settings.host}:{settings.port}"
    if error.errno == errno.EADDRINUSE:
        reason = f"SCENE_PORT: {place} is in use by another program; set SCENE_PORT to a free one"
    else:
        variable = "SCENE_PORT" if error.errno == errno.EACCES else "SCENE_HOST"
        reason = f"{variable}: the service cannot listen on {place}: {error.strerror or error}"
    sys.stderr.write(f"{reason}\n")
    return 3


def serve(settings: Settings, began: float) -> int:
    """Serve from this process until it is stopped.

    Args:
        began: `time.monotonic()` when the start began.

    Returns:
        The exit status: not 0 where the service did not start.
    """
    try:
        sockets = _bind(settings.host, settings.port, settings.client_timeout)
    except OSError as error:
        return _refuse_address(settings, error)
    # What starting makes stays: looking through it for garbage takes a fifth of the time. The
    # runtime turns the collector on again when it serves.
    gc.disable()
    gc.set_threshold(_YOUNG, *gc.get_threshold()[1:])
    _give_back_what_is_large()
    # Products of one question are small, and threads for them would take cores from other
    # processes. numpy reads this when it is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from app.server import build

    server = build(settings, began)
    # Ctrl-C has ended the server in order by the time it comes up here.
    with suppress(KeyboardInterrupt):
        try:
            server.run(sockets)
        except OSError as error:
            # Two services that start at once can both bind; one of them listens first.
            if server.started or error.errno != errno.EADDRINUSE:
                raise
            return _refuse_address(settings, error)
    return 0 if server.started else 3


if __name__ == "__main__":
    sys.exit(main())
