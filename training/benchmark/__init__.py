"""Every baseline and machine on the same scenes: what `python -m training benchmark` runs.

entries.py   the rows of the tables: what each is, and how it is trained
measure.py   the loop over rows and sources, with files that it resumes from
summary.py   means over training seeds, paired differences, JSON and Markdown
command.py   the command line
"""

from training.benchmark.entries import Entry, baseline_entries, machine_entry
from training.benchmark.measure import BenchmarkError, measure_entries
from training.benchmark.summary import MeanOverSeeds, Results, summarise

__all__ = [
    "BenchmarkError",
    "Entry",
    "MeanOverSeeds",
    "Results",
    "baseline_entries",
    "machine_entry",
    "measure_entries",
    "summarise",
]
