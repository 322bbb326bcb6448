"""Entry point of `python -m training`."""

from __future__ import annotations

import sys
from importlib.util import find_spec

if __name__ == "__main__":
    if find_spec("torch") is None:
        sys.exit("error: training needs more packages than the service. Install: make training")

    from training.cli import app

    app(prog_name="python -m training")
