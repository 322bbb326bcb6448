"""The scene-reasoning service, and the model code that it shares with training."""

__version__ = "2.0.0"
