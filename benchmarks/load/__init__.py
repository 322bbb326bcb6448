"""Throughput and latency of the running service under load, beside a plain FastAPI app."""
