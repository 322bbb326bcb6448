"""Evaluation tasks for models. Each module of tasks documents its protocol.

In signatures, V, A and C are the numbers of classes, relations and room types, and n is the largest
number of classes of a scene. `v` is the presence of classes.
"""

from __future__ import annotations
