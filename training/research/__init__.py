"""Experiments: the commands `benchmark`, `ablate` and `tune` of `python -m training`.

An entry of a result table is a model and its training seed. `benchmark` and `ablate` measure all
entries on the same scenes. They report bootstrap intervals, and the paired difference between each
model and one reference model (`evaluation.results`).

entries.py    the entries of a result table, and the training of their models
measure.py    evaluation of entries in several processes, with reports on disk
plots.py      plots of the calibration
benchmark.py  comparison of machines and baselines
ablate.py     comparison of a configuration with variants of it
tune.py       search for better settings on validation scenes
"""
