"""``python -m app``: serve with the settings of the environment."""

from __future__ import annotations

import sys
from contextlib import suppress

from pydantic import ValidationError

from app.server import server
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
    # Ctrl-C has ended the server in order by the time it comes up here.
    with suppress(KeyboardInterrupt):
        server(settings).run()
    return 0


if __name__ == "__main__":
    sys.exit(main())
