"""Leak-free evaluation of a machine on encoded scenes; see each module for its task."""

from __future__ import annotations
