"""Measurements of the physical sense of a running service."""
