"""Experiments: the commands `benchmark`, `ablate`, `compare` and `tune` of `python -m training`.

A row of a result table is a trained machine, a baseline, or one of two compared models. The first
three commands measure all rows on the same scenes. They report bootstrap intervals, and the paired
difference between each row and one reference row. Their JSON files have the same format
(results.py).

rows.py         the rows of a result table, and the training of their models
measure.py      evaluation of rows in several processes, with reports on disk
results.py      means over training seeds, paired differences, output as JSON and Markdown
plots.py        plots of the results
benchmark.py    comparison of machines and baselines, and two further experiments with them
ablate.py       comparison of a configuration with variants of it
compare.py      comparison of two models on scenes held out from both
tune.py         search for better settings on validation scenes
sides.py        the two models of `compare`, and the scenes held out from both
translation.py  questions to a model about the classes of another model
gate.py         decision whether a new model version may replace the served version
"""
