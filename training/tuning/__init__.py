"""Search for settings by validation scenes: what `python -m training tune` runs.

space.py     what may vary, read from TOML, and random draws from it
study.py     trials on disk: each is run, judged, written down, and never run again
command.py   the command line
"""

from training.tuning.space import Interval, Space, load_space, proposals, shipped_spaces
from training.tuning.study import Study, Trial, TuningError

__all__ = [
    "Interval",
    "Space",
    "Study",
    "Trial",
    "TuningError",
    "load_space",
    "proposals",
    "shipped_spaces",
]
