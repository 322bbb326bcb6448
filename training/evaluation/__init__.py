"""Evaluation tasks for models. Each module measures one task and documents its protocol."""

from __future__ import annotations
