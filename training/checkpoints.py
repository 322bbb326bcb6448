"""Training state on disk: written atomically at the end of every epoch, so that any stop can
resume."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch


class CheckpointError(RuntimeError):
    """A checkpoint that cannot be resumed from; says why."""


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write to a sibling, fsync, rename: a crash leaves the old checkpoint."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    with temporary.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def load_checkpoint(path: Path, digest: str) -> dict[str, Any]:
    """Read a checkpoint that began with the configuration and scenes of the given digest.

    Raises:
        CheckpointError: unreadable, or begun under another configuration or on other scenes.
    """
    try:
        state: dict[str, Any] = torch.load(path, weights_only=True)
    except Exception as error:
        raise CheckpointError(f"{path.name} cannot be read: {error}") from error
    if state.get("digest") != digest:
        raise CheckpointError(
            f"{path.name} was begun with another configuration or on other scenes: use --fresh to "
            "start over"
        )
    return state
