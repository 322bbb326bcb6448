"""Run the cells of a notebook in order, and store their texts and pictures in it.

Usage: python scripts/notebook.py examples/a-day-of-a-robot.ipynb [OUTPUT.ipynb]

Jupyter shows the same notebook. This script needs no kernel, so continuous integration runs it.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt


def run_cell(source: str, names: dict[str, Any], number: int) -> list[dict[str, Any]]:
    """Run the code of a cell. Return its text and its open figures as outputs of a notebook."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(source, f"cell {number}", "exec"), names)
    outputs: list[dict[str, Any]] = []
    if text := printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": lines(text)})
    for figure in plt.get_fignums():
        picture = io.BytesIO()
        plt.figure(figure).savefig(picture, format="png", metadata={"Software": None})
        data = {"image/png": base64.b64encode(picture.getvalue()).decode("ascii")}
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
    plt.close("all")
    return outputs


def lines(text: str) -> list[str]:
    """Return a text as a notebook stores it."""
    return text.splitlines(keepends=True)


def run(notebook: dict[str, Any]) -> None:
    """Run all code cells of a notebook, and replace their outputs.

    Raises:
        Exception: that of the first cell that fails.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, cell in enumerate(code, 1):
        cell["outputs"] = run_cell("".join(cell["source"]), names, number)
        cell["execution_count"] = number


def main(source: str, target: str | None = None) -> None:
    """Run a notebook in its folder, as Jupyter does."""
    path, output = Path(source).resolve(), Path(target or source).resolve()
    notebook = json.loads(path.read_text("utf-8"))
    os.chdir(path.parent)
    run(notebook)
    output.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
