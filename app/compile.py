"""``python -m app.compile``: compile kernels and sources for this machine before a start."""

import asyncio
import compileall
import sys
from logging.config import dictConfig
from pathlib import Path

from app.serving.logs import log_config
from app.serving.runtime import Runtime
from app.settings import Settings


def main() -> int:
    """Warm up every model of the store, then compile all Python sources to bytecode.

    Return the exit status: 1 if a model, an alias or the store is not usable, else 0.
    """
    settings = Settings()
    dictConfig(log_config(settings))
    runtime = Runtime(settings)
    asyncio.run(runtime.start())
    runtime.stop()
    compileall.compile_dir(Path(__file__).parent, quiet=1)
    # The runtime has logged each failure.
    return 1 if runtime.models.failures else 0


if __name__ == "__main__":
    sys.exit(main())
