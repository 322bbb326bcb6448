"""``python -m scene_client`` runs the command `scene`."""

from __future__ import annotations

from scene_client.command import app

app(prog_name="scene")
