"""``python -m app``: serve with the settings of the environment."""

from __future__ import annotations

import sys

import uvicorn
from pydantic import ValidationError

from app.main import create_app
from app.serving.logs import log_config
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
    uvicorn.run(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        root_path=settings.root_path,
        log_config=log_config(settings.log_level, settings.log_format),
        access_log=False,
        server_header=False,
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
