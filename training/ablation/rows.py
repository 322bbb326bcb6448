"""The configurations of an ablation: the full model with one thing changed in each."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from training.config import Config, ConfigError, load_config, with_settings


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    what: str
    start: str | None = Field(default=None, alias="from")
    changes: dict[str, Any] = Field(default_factory=dict)


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    row: tuple[_Row, ...] = Field(min_length=1)


def shipped_ablations() -> dict[str, Path]:
    """The ablations that come with the package, by the name of the full model."""
    folder = Path(__file__).parents[1] / "configs/ablations"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_rows(path: Path, full: Config) -> list[Config]:
    """The configurations of a file, on the scenes of the full model, which is not among them.

    The name of each is its row's, the description says what it changes.

    Raises:
        ConfigError: no such file, not TOML, a setting that does not exist or fit, a name twice, or
            a row that changes nothing.
    """
    try:
        file = _File.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError as error:
        raise ConfigError(f"no ablation {path}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path.name} is not TOML: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{path.name}: {place}: {first['msg']}") from error
    configs: dict[str, Config] = {}
    for row in file.row:
        if row.name in configs or row.name == full.name:
            raise ConfigError(f"{path.name}: two rows are called {row.name}")
        configs[row.name] = _config(row, full, path.name)
    return list(configs.values())


def _config(row: _Row, full: Config, file: str) -> Config:
    try:
        start = load_config(row.start) if row.start else full
        changed = with_settings(start, row.changes).model_copy(update={"data": full.data})
        if changed == full:
            raise ConfigError(f"it changes nothing in {full.name}")
        values = changed.model_dump() | {"name": row.name, "description": row.what}
        return Config.model_validate(values)
    except ConfigError as error:
        raise ConfigError(f"{file}: {row.name}: {error}") from error
    except ValidationError as error:
        raise ConfigError(f"{file}: {row.name}: {error.errors()[0]['msg']}") from error
