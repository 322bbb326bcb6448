"""What each part of a model is worth: what `python -m training ablate` runs.

rows.py      the configurations to compare, read from TOML
table.py     Markdown with paired differences to the full model
command.py   the command line; training and measuring are the benchmark's
"""

from training.ablation.rows import load_rows, shipped_ablations
from training.ablation.table import markdown

__all__ = ["load_rows", "markdown", "shipped_ablations"]
