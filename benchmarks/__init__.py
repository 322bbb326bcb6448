"""Benchmarks: each compares with a yardstick measured in the same run. See docs/benchmarks.md."""
