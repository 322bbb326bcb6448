"""``python -m app.compile``: compile loops for this machine, and sources, before they are run.

The service does so by itself where it finds nothing compiled, and starts a minute or so later;
where it must not write, at every start.
"""

from __future__ import annotations

import asyncio
import compileall
import sys
from pathlib import Path

from app.serving.metrics import Unmeasured
from app.serving.reading import Limits
from app.serving.runtime import Runtime
from app.settings import Settings


def main() -> int:
    """Ask every model of the store everything once; then turn all sources into byte code.

    Returns:
        The exit status: 1 where one of them cannot be used.
    """
    settings = Settings()
    runtime = Runtime(settings.store, Limits(), settings.queue_rows, Unmeasured(), poll=0)
    asyncio.run(runtime.start())
    runtime.stop()
    compileall.compile_dir(Path(__file__).parent, quiet=1)
    failures = runtime.models.failures
    for failure in failures.values():
        sys.stderr.write(f"{failure.subject}: {failure.reason}: {failure.detail}\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
