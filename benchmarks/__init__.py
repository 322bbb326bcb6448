"""Benchmarks. Each compares our code with a reference in the same run; see docs/benchmarks.md."""
