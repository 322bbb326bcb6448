"""Reproduction of Bozcan et al. (2018): machines, training, tasks and tables.

Source: Bozcan, Oymak, Alemdar, Kalkan, "What is (missing or wrong) in the scene? A hybrid deep
Boltzmann machine for contextualized scene modeling", ICRA 2018.
"""
