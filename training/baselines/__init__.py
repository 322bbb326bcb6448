"""Baselines that the evaluation trains in the same run, on the same scenes."""

from __future__ import annotations
