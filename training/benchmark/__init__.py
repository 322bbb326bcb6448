"""Every baseline and machine on the same scenes: what `python -m training benchmark` runs.

domains.py   configurations that learn from the same scenes
entries.py   the rows of the tables: what each is, and how it is trained
measure.py   a row's reports, with files that it resumes from
workers.py   rows measured by several processes
summary.py   means over training seeds, paired differences, JSON and Markdown
remarks.py   what has to be said beside the figures
sections.py  results of a domain, from those of its sections
plots.py     what is drawn beside the tables
compare.py   a domain from its scenes to its tables, the seed paper's protocol, shuffled labels
command.py   the command line
"""

from training.benchmark.compare import Options, compare_domain
from training.benchmark.domains import Domain, read_domains
from training.benchmark.entries import Entry, Material, baseline_entries, machine_entry
from training.benchmark.measure import BenchmarkError, Plan, measure_entries
from training.benchmark.summary import MeanOverSeeds, Results, summarise

__all__ = [
    "BenchmarkError",
    "Domain",
    "Entry",
    "Material",
    "MeanOverSeeds",
    "Options",
    "Plan",
    "Results",
    "baseline_entries",
    "compare_domain",
    "machine_entry",
    "measure_entries",
    "read_domains",
    "summarise",
]
