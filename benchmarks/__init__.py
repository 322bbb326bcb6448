"""Benchmarks: each a ratio against a yardstick measured in the same run. See docs/benchmarks.md."""
