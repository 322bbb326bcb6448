"""What a search may vary: a TOML file of settings with their choices or intervals.

    "machine.H1" = [100, 200, 400]
    "training.weight_decay" = { low = 0.01, high = 0.1, log = true }

Random search rather than a grid: where few of the settings matter, every trial tries a new value of
each of those.

Source: Bergstra and Bengio, "Random search for hyper-parameter optimization" (2012).
"""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from training.config import Config, ConfigError, with_settings

# Trials must differ by these alone: all learn from the same scenes, and a lucky seed is no setting.
_FIXED = ("data.", "training.seed", "training.threads")


class Interval(BaseModel):
    """Numbers between two bounds; whole ones where both bounds are whole.

    Attributes:
        low, high: the bounds, both may be drawn.
        log: draw the logarithm uniformly, not the number itself.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    low: int | float
    high: int | float
    log: bool = False

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low must be below high, not {self.low} and {self.high}")
        if self.log and self.low <= 0:
            raise ValueError(f"a logarithmic interval must be positive, not from {self.low}")
        return self

    @property
    def whole(self) -> bool:
        """Whether whole numbers are drawn."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @property
    def size(self) -> float:
        """How many numbers may be drawn."""
        return self.high - self.low + 1 if self.whole else math.inf

    def draw(self, rng: np.random.Generator) -> int | float:
        """One number, fractions to three digits, so that configurations stay readable."""
        low, high = float(self.low), float(self.high)
        if self.whole:
            # Each whole number owns the half steps around it, the bounds as much as the others.
            low, high = low - 0.5, high + 0.5
        value = (
            math.exp(rng.uniform(math.log(low), math.log(high)))
            if self.log
            else rng.uniform(low, high)
        )
        rounded = round(value) if self.whole else float(f"{value:.3g}")
        return min(max(rounded, self.low), self.high)


Space: TypeAlias = Mapping[str, list[Any] | Interval]


def shipped_spaces() -> dict[str, Path]:
    """The spaces that come with the package, by the name of their configuration."""
    folder = Path(__file__).parents[1] / "configs/spaces"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_space(path: Path) -> Space:
    """Read a space.

    Raises:
        ConfigError: no such file, not TOML, or an entry that is neither choices nor an interval.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"no search space {path}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path.name} is not TOML: {error}") from error
    space: dict[str, list[Any] | Interval] = {}
    for name, entry in values.items():
        if isinstance(entry, list) and entry:
            space[name] = entry
            continue
        try:
            space[name] = Interval.model_validate(entry)
        except ValidationError as error:
            reason = error.errors()[0]
            place = ".".join([name, *(str(part) for part in reason["loc"])])
            raise ConfigError(
                f"{path.name}: {place}: {reason['msg']}; write a list of choices, or "
                "{ low = ..., high = ... }"
            ) from error
    if not space:
        raise ConfigError(f"{path.name} names no setting")
    return space


def proposals(config: Config, space: Space, seed: int, count: int) -> list[dict[str, Any]]:
    """The first `count` distinct draws, or all there are; more of them begin with the same ones.

    Raises:
        ConfigError: a setting that does not exist or must not vary, or a draw that does not fit
            the configuration.
    """
    for name in space:
        if name.startswith(_FIXED):
            raise ConfigError(f"{name!r} is no setting to search: all trials share it")
    rng = np.random.default_rng(seed)
    found: dict[str, dict[str, Any]] = {}
    while len(found) < min(count, _size(space)):
        settings = {
            name: entry.draw(rng) if isinstance(entry, Interval) else _choose(entry, rng)
            for name, entry in space.items()
        }
        found.setdefault(json.dumps(settings), settings)
    for settings in found.values():
        with_settings(config, settings)
    return list(found.values())


def _choose(choices: list[Any], rng: np.random.Generator) -> Any:
    return choices[int(rng.integers(len(choices)))]


def _size(space: Space) -> float:
    """How many different draws there are."""
    return math.prod(
        entry.size if isinstance(entry, Interval) else len({json.dumps(c) for c in entry})
        for entry in space.values()
    )
