"""Rows × tasks: what `python -m training benchmark`, `ablate`, `compare` and `tune` run.

A row can be asked the tasks of `training.evaluation`: a trained machine, a baseline, one of two
models side by side. Every command measures rows (measure.py), summarises them with bootstrap
intervals and paired differences to one row, and writes one format (results.py).

rows.py         rows and how each is trained
measure.py      reports on disk, what is resumed, several processes
results.py      means over seeds, paired differences, JSON and Markdown
plots.py        plots beside the tables
benchmark.py    all baselines and machines on the same scenes; the seed protocol; shuffled scenes
ablate.py       a configuration and the same with one thing changed
compare.py      two models on scenes that neither has learnt from
tune.py         settings searched on validation scenes
sides.py        the two models of a comparison, and scenes that neither has learnt from
translation.py  a model asked in another model's classes
gate.py         whether a version may replace the served one
"""
