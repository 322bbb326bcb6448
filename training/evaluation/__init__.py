"""Leak-free evaluation of a machine on encoded scenes; each module documents its task."""

from __future__ import annotations
