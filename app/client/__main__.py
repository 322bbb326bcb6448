"""``python -m app.client``: the command `scene`."""

from __future__ import annotations

from app.client.command import app

app(prog_name="scene")
