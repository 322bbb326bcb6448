"""Experiments: the commands `benchmark`, `ablate` and `tune` of `python -m training`.

An entry of a result table is a model and its training seed. `benchmark` and `ablate` measure all
entries on the same scenes. They report bootstrap intervals, and the paired difference between each
model and one reference model (`evaluation.results`).
"""
