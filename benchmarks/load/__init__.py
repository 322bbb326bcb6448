"""Throughput and latency of the running service under load, beside an echo of it."""
