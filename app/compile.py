"""``python -m app.compile``: compile loops for this machine, and sources, before they are run.

The service compiles by itself where it finds nothing compiled, and starts a minute or so later;
where it cannot keep the result, it does so at every start.
"""

from __future__ import annotations

import asyncio
import compileall
import sys
from logging.config import dictConfig
from pathlib import Path

from app.serving.logs import log_config
from app.serving.runtime import Runtime
from app.settings import Settings


def main() -> int:
    """Ask every model of the store everything once; then turn all sources into byte code.

    Returns:
        The exit status: 1 where one of them cannot be used.
    """
    settings = Settings()
    dictConfig(log_config(settings.log_level, settings.log_format, settings.secrets))
    runtime = Runtime(settings)
    asyncio.run(runtime.start())
    runtime.stop()
    compileall.compile_dir(Path(__file__).parent, quiet=1)
    # The runtime has logged each of them.
    return 1 if runtime.models.failures else 0


if __name__ == "__main__":
    sys.exit(main())
