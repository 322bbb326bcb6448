"""``python -m app``: start the service with the settings of the environment."""

import argparse
import ctypes
import errno
import gc
import os
import signal
import socket
import sys
from time import monotonic
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from app.settings import Settings


def _refuse_arguments(arguments: list[str] | None) -> None:
    """Exit with status 2 after unknown arguments. After --help, print the settings and exit."""
    from app.settings import Settings

    lines = ["Start the service. These settings are environment variables:\n"]
    for name, field in Settings.model_fields.items():
        default = field.get_default(call_default_factory=True)
        lines.append(f"  SCENE_{name.upper():<24}{'-' if default in (None, (), '') else default}")
    parser = argparse.ArgumentParser(
        prog="python -m app",
        description="\n".join(lines),
        epilog="The second column has the defaults. docs/operations.md describes the settings.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _, unknown = parser.parse_known_args(arguments)
    if unknown:
        parser.error(
            f"unknown arguments: {' '.join(unknown)}; settings are environment variables, "
            "for example: SCENE_PORT=8001 python -m app"
        )


def main(arguments: list[str] | None = None) -> int:
    """Serve until the process is stopped. Return 2 for invalid settings, else as `serve`.

    Arguments end the process (SystemExit).
    """
    began = monotonic()
    from pydantic import ValidationError

    from app.settings import Settings

    _refuse_arguments(arguments)
    try:
        settings = Settings()
    except ValidationError as error:
        for detail in error.errors(include_url=False, include_input=False):
            variable = "SCENE_" + "_".join(str(part) for part in detail["loc"]).upper()
            sys.stderr.write(f"{variable}: {detail['msg'].removeprefix('Value error, ')}\n")
        return 2
    return serve(settings, began)


def tune() -> None:
    """Set the garbage collector, the C library and OpenBLAS, before the import of numpy."""
    # Objects that the start creates stay in use. A search for garbage among them would take a fifth
    # of the startup time. The runtime enables the garbage collector again after the start.
    gc.disable()
    # A collection after 700 new objects, Python's default, costs 4 to 8 % of a request's time.
    gc.set_threshold(10_000, *gc.get_threshold()[1:])
    # Return freed blocks of 128 KiB or more to the operating system at once. By default, the C
    # library raises this limit, and the process would hold 20 MB of unused memory.
    if (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:
        mallopt(-3, 128 * 1024)  # M_MMAP_THRESHOLD, limit in bytes; see mallopt(3)
    # A question needs only small matrix products. More threads would take cores from other
    # processes. numpy reads this variable at its import.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _bind(host: str, port: int, send_timeout: float) -> list[socket.socket]:
    """Bind sockets to all addresses of a host, without listening; `::` means IPv4 and IPv6.

    Linux closes a connection whose client does not acknowledge the bytes sent within
    ``send_timeout`` seconds. On other operating systems, only a proxy can limit this time.

    Raises:
        OSError: the host does not have a usable address, or the port is in use.
    """
    bound: list[socket.socket] = []
    problem: OSError | None = None
    every = None if host == "::" else host
    addresses = socket.getaddrinfo(every, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    for family, kind, protocol, _, (name, *rest) in dict.fromkeys(addresses):
        try:
            listener = socket.socket(family, kind, protocol)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # accepted connections inherit the option
                milliseconds = int(send_timeout * 1e3)
                listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, milliseconds)
            # A free port for the first address serves all addresses.
            number = bound[0].getsockname()[1] if bound else port
            listener.bind((name, number, *rest[1:]))
        except OSError as error:
            # The machine may lack IPv6 although its name has an IPv6 address.
            if error.errno not in {errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT}:
                raise
            problem = error
        else:
            bound.append(listener)
    if problem is not None and not bound:
        raise problem
    return bound


def _refuse_address(host: str, port: int, variable: str, error: OSError) -> int:
    """Print why the service cannot listen on its address; return the exit status."""
    address = f"{host}:{port}"
    if error.errno == errno.EADDRINUSE:
        reason = f"{variable}: another program uses {address}; set {variable} to a free port"
    else:
        cause = variable if error.errno == errno.EACCES else "SCENE_HOST"
        reason = f"{cause}: the service cannot listen on {address}: {error.strerror or error}"
    sys.stderr.write(f"{reason}\n")
    return 3


def serve(settings: "Settings", began: float) -> int:
    """Serve until the process is stopped. Return its exit status: 0, or 3 if it could not start."""
    sockets, health = list[socket.socket](), list[socket.socket]()
    variable, port = "SCENE_PORT", settings.port
    try:
        sockets = _bind(settings.host, port, settings.client_timeout)
        if settings.health_port is not None:
            variable, port = "SCENE_HEALTH_PORT", settings.health_port
            health = _bind(settings.host, port, settings.client_timeout)
            for listener in health:
                listener.listen()
    except OSError as error:
        return _refuse_address(settings.host, port, variable, error)
    tune()
    from app.server import Server

    server = Server(settings, began, health)
    try:
        server.run(sockets)
    except OSError as error:
        # Two services that start together can both bind, but only one of them can listen.
        if server.started or error.errno != errno.EADDRINUSE:
            raise
        return _refuse_address(settings.host, settings.port, "SCENE_PORT", error)
    return 0 if server.started else 3


if __name__ == "__main__":
    # Ctrl-C during the start ends the process at once, without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.exit(main())
