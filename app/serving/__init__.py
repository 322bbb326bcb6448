"""Serving: read scenes, hold the loaded models and answer questions; independent of HTTP."""
