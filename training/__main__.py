"""Entry point of `python -m training`."""

from __future__ import annotations

import gc
import sys
from importlib.util import find_spec

if __name__ == "__main__":
    if find_spec("torch") is None:
        sys.exit("error: training needs more packages than the service. Install: make setup")

    # What imports create stays in use. A search for garbage among it takes a tenth of the start.
    gc.disable()
    from training.cli import app

    gc.freeze()
    gc.enable()
    app(prog_name="python -m training")
