"""Evaluation tasks for models. Each module measures one task and documents its protocol.

`structure` is always a mask of structure classes such as walls, (V,) bool. They are evidence, but
never questions. `v` is the presence of classes in scenes, (scenes, V).
"""

from __future__ import annotations
