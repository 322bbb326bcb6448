"""Benchmarks: each compares our code with a yardstick in the same run. See docs/benchmarks.md."""
