"""Load test: throughput and latency of the service, compared with a minimal FastAPI app."""
