"""``python -m app.compile``: compile all loops for this machine, ahead of the first start.

The service does so by itself where it finds nothing compiled, and starts some ten seconds later.
"""

from __future__ import annotations

import sys

from app.registry import Store, load_model_set
from app.serving.models import prepare
from app.settings import Settings


def main() -> int:
    """Ask every model of the store everything once.

    Returns:
        The exit status: 1 where one of them cannot be used.
    """
    failures = prepare(load_model_set(Store(Settings().store))).failures
    for failure in failures.values():
        sys.stderr.write(f"{failure.subject}: {failure.reason}: {failure.detail}\n")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
