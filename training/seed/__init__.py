"""The evaluation protocol and the configurations of Bozcan et al. (2018)."""
