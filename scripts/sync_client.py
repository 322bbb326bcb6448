"""Generate the blocking Python client (sync.py) from the asynchronous client (asynchronous.py).

Usage: python scripts/sync_client.py   (`make format` runs this script)
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

import unasync

PACKAGE: Final = Path(__file__).resolve().parent.parent / "clients/python/scene_client"
SOURCE: Final = PACKAGE / "asynchronous.py"
TARGET: Final = PACKAGE / "sync.py"
HEADER: Final = "# Written by `make format` from asynchronous.py; do not edit.\n"
NAMES: Final = {
    "AsyncBaseTransport": "BaseTransport",
    "AsyncClient": "Client",
    "aclose": "close",
    "aiter_bytes": "iter_bytes",
    "anyio": "time",
    "async_deadline": "deadline",
    "async_transport": "DeadlineTransport",
}


def generated() -> str:
    """Return the source code of the blocking client, formatted by ruff."""
    with tempfile.TemporaryDirectory() as scratch:
        folders = Path(scratch, "async"), Path(scratch, "sync")
        folders[0].mkdir()
        source = folders[0] / TARGET.name
        source.write_text(SOURCE.read_text("utf-8"), "utf-8")
        rule = unasync.Rule(str(folders[0]), str(folders[1]), additional_replacements=NAMES)
        unasync.unasync_files([str(source)], [rule])
        text = HEADER + (folders[1] / TARGET.name).read_text("utf-8")
    for command in (("check", "--fix-only"), ("format",)):
        ruff = (sys.executable, "-m", "ruff", *command, "-q", "--stdin-filename", str(TARGET), "-")
        text = subprocess.run(ruff, input=text, capture_output=True, text=True, check=True).stdout
    return text


if __name__ == "__main__":
    TARGET.write_text(generated(), "utf-8")
