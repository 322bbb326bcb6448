"""The shipped rows of `ablate` and search spaces of `tune`, or the user's files instead of them."""

from __future__ import annotations

from pathlib import Path

from training.fit.configuration import Config, ConfigError


def shipped_files(kind: str) -> dict[str, Path]:
    """Return the shipped "ablations" or "spaces" by the name of their configuration."""
    folder = Path(__file__).parent / "configs" / kind
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def own_or_shipped(path: Path | None, config: Config, kind: str, option: str) -> Path:
    """Return the file of the user, or the shipped file of a kind for a configuration.

    Raises:
        ConfigError: the user names no file, and no file is shipped.
    """
    shipped = shipped_files(kind)
    if path is None and config.name not in shipped:
        raise ConfigError(
            f"{config.name} has no shipped {kind} (available for: {', '.join(shipped)}). Pass a "
            f"TOML file with {option}"
        )
    return path or shipped[config.name]
