"""`python -m training ablate`: compare a full model with ablations, its variants."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel, Field, ValidationError

from training.fit.configuration import Config, ConfigError, first_error
from training.research.benchmark import Data, Fresh, Limit, Workers, compare_machines, console
from training.research.measure import resumable
from training.runs.config_files import (
    data_folder,
    load_config,
    own_or_shipped,
    read_toml,
    with_settings,
)

PRIMARY: dict[str, tuple[str, ...]] = {
    "T1a relations": ("R-precision, instance counts",),
    "T1 pairs": ("accuracy", "accuracy, unseen pairs", "accuracy, rare classes"),
    "T1b completion": ("R-precision",),
    "T2 missing": ("MRR, one removed", "MRR, 25 % shown"),
    "T2-at missing at a place": ("MRR",),
    "T3 outliers": ("hit@1, uniform", "hit@1, by popularity", "hit@1, signature"),
}
"""Tasks of an ablation, and their metrics in the tables. JSON files hold all metrics."""


def ablate(
    configuration: Annotated[str, typer.Argument(help="configuration of the full model")],
    rows: Annotated[
        Path | None, typer.Option(help="TOML file of the ablations; by default the shipped file")
    ] = None,
    row: Annotated[
        list[str] | None, typer.Option(help="train only these ablations and the full model")
    ] = None,
    data: Data = None,
    folder: Annotated[Path, typer.Option("--folder", help="folder for runs and results")] = Path(
        "runs/ablation"
    ),
    seeds: Annotated[int, typer.Option(min=1, help="number of training seeds per model")] = 1,
    limit: Limit = 300,
    workers: Workers = 2,
    fresh: Fresh = False,
) -> None:
    """Train the full model and each of its ablations, and compare them on the same test scenes.

    The command writes results.json and results.md into FOLDER/CONFIGURATION. If the training of
    an ablation diverges, the results contain the error in place of its metrics. After Ctrl-C, run
    the same command again: it skips finished models and tasks.
    """
    with resumable(console):
        configs = _configs(configuration, rows, row)
        compare_machines(
            configs, data_folder(configuration, configs[0], data), folder / configs[0].name,
            PRIMARY, seeds=seeds, baselines=(), limit=limit, workers=workers, fresh=fresh,
        )  # fmt: skip


def _configs(reference: str, path: Path | None, names: Sequence[str] | None) -> list[Config]:
    """Return the configurations of the full model and of the selected ablations."""
    full = load_config(reference)
    rows = load_rows(own_or_shipped(path, full, "ablations", "--rows"), full)
    all_names = [row.name for row in rows]
    if unknown := sorted(set(names or ()) - set(all_names)):
        raise ConfigError(f"unknown rows {unknown}: choose from {', '.join(all_names)}")
    return [full, *(row for row in rows if not names or row.name in names)]


class _Change(BaseModel, extra="forbid", frozen=True):
    name: str
    what: str
    start: str | None = Field(default=None, alias="from")
    changes: dict[str, Any] = Field(default_factory=dict)


class _File(BaseModel, extra="forbid", frozen=True):
    row: tuple[_Change, ...] = Field(min_length=1)


def load_rows(path: Path, full: Config) -> list[Config]:
    """Read one configuration for each `[[row]]` of a TOML file, with the scenes of the full model.

    Raises:
        ConfigError: the file is missing or not TOML, a setting is unknown or invalid, two ablations
            have the same name, or an ablation has the same settings as the full model.
    """
    try:
        file = _File.model_validate(read_toml(path))
    except ValidationError as error:
        raise ConfigError(f"{path.name}: {first_error(error)}") from error
    configs = [full]
    for row in file.row:
        if any(row.name == config.name for config in configs):
            raise ConfigError(f"{path.name}: the name {row.name} occurs twice: rename one row")
        configs.append(_config(row, full, path.name))
    return configs[1:]


def _config(row: _Change, full: Config, file: str) -> Config:
    """Return the configuration of one ablation; see `load_rows` for the errors."""
    try:
        start = load_config(row.start) if row.start else full
        changed = with_settings(start, row.changes).model_copy(update={"data": full.data})
        if changed == full:
            raise ConfigError(f"the row has the same settings as {full.name}: change a setting")
        names = {"name": row.name, "description": row.what}
        return Config.model_validate(changed.model_dump() | names)
    except (ConfigError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise ConfigError(f"{file}: {row.name}: {reason}") from error
