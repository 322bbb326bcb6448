"""Experiments: the commands `benchmark`, `ablate`, `compare` and `tune` of `python -m training`.

A row is a contender of `training.evaluation`: a trained machine, a baseline, or one of two compared
models. Each command measures rows (measure.py) and summarises them with bootstrap intervals and
paired differences to one row. All commands write the same format (results.py).

rows.py         rows and their training
measure.py      reports on disk, resumption, several processes
results.py      means over seeds, paired differences, JSON and Markdown
plots.py        plots for the tables
benchmark.py    all baselines and machines on the same scenes; the seed protocol; shuffled scenes
ablate.py       a configuration and variants with one change
compare.py      two models on scenes held out from both
tune.py         search for settings on validation scenes
sides.py        the two models of a comparison, and their common held-out scenes
translation.py  a model queried with the classes of another model
gate.py         decision whether a version may replace the served version
"""
