"""Compiled loops between processes: what was loaded from disk is packed, and is of use still."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

LOOPS = """
from app.compiling import compiled

@compiled
def inner(x):
    total = 0.0
    for value in x:
        total += value**1.5
    return total

@compiled
def outer(x):
    return inner(x) + 1.0
"""

PROGRAM = """
import json
import numpy as np
from app.compiling import compiled, pack
from loops import inner, outer

x = np.full(3, 4.0)
found = [inner(x), outer(x)]
libraries = [loop.overloads[loop.signatures[0]].library for loop in (inner, outer)]
unpacked = [library._shared_module is not None for library in libraries]
pack()
pack()
packed = [library._shared_module is None for library in libraries]

@compiled
def both(x):
    return inner(x) + 10.0 * outer(x)

found.append(both(x))
found.append(inner(x.astype(np.float32)))
hits = [sum(loop.stats.cache_hits.values()) for loop in (inner, outer)]
print(json.dumps({"found": found, "hits": hits, "unpacked": unpacked, "packed": packed}))
"""


def run(folder: Path) -> Any:
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(Path.cwd()), str(folder)]),
        "NUMBA_CACHE_DIR": str(folder / "cache"),
    }
    # A file, since numba keeps nothing of functions that have none.
    done = subprocess.run(
        [sys.executable, folder / "program.py"],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return json.loads(done.stdout)


def test_what_was_loaded_is_packed_and_can_still_be_part_of_other_loops(tmp_path: Path) -> None:
    (tmp_path / "loops.py").write_text(LOOPS)
    (tmp_path / "program.py").write_text(PROGRAM)
    expected = [24.0, 25.0, 274.0, 24.0]
    first = run(tmp_path)
    assert first["found"] == expected
    assert first["hits"] == [0, 0]
    second = run(tmp_path)
    assert second["found"] == expected
    assert second["hits"][1] == 1
    # Else there is nothing to pack any more, and nothing shows that packing does no harm.
    assert second["unpacked"] == [True, True]
    assert second["packed"] == [True, True]
