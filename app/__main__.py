"""``python -m app``: serve with the settings of the environment."""

from __future__ import annotations

import ctypes
import gc
import sys
from contextlib import suppress

from pydantic import ValidationError

from app.settings import Settings


def main() -> int:
    """Serve until stopped.

    Returns:
        The exit status: 2 where the settings make no sense.
    """
    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors(include_url=False, include_input=False):
            variable = "SCENE_" + "_".join(str(part) for part in fault["loc"]).upper()
            sys.stderr.write(f"{variable}: {fault['msg'].removeprefix('Value error, ')}\n")
        return 2
    return serve(settings)


# Containers made until the collector looks at the youngest. An answer is some two hundred, all of
# them freed by their counts of references: to look every 700, as is usual, takes 4 to 8 % of a
# request's time.
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


def serve(settings: Settings) -> int:
    """Serve from this process until it is stopped.

    Returns:
        The exit status: not 0 where the service did not start.
    """
    # What starting makes stays: looking through it for garbage takes a fifth of the time. The
    # runtime turns the collector on again when it serves.
    gc.disable()
    gc.set_threshold(_YOUNG, *gc.get_threshold()[1:])
    _give_back_what_is_large()
    from app.server import build

    server = build(settings)
    # Ctrl-C has ended the server in order by the time it comes up here.
    with suppress(KeyboardInterrupt):
        server.run()
    return 0 if server.started else 3


if __name__ == "__main__":
    sys.exit(main())
