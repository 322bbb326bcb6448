"""Experiments: the commands `benchmark`, `ablate` and `tune` of `python -m training`.

A row of a result table is a trained machine or a baseline. `benchmark` and `ablate` measure all
rows on the same scenes. They report bootstrap intervals, and the paired difference between each row
and one reference row (`evaluation.results`).

rows.py         the rows of a result table, and the training of their models
measure.py      evaluation of rows in several processes, with reports on disk
plots.py        plots of the results
benchmark.py    comparison of machines and baselines, and two further experiments with them
ablate.py       comparison of a configuration with variants of it
tune.py         search for better settings on validation scenes
settings.py     the shipped rows of `ablate` and search spaces of `tune`
"""
