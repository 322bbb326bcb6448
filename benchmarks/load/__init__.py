"""Throughput and latency of the running service under load, compared with a plain FastAPI app."""
