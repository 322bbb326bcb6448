"""The files of configurations: which exist, how to read and write them."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from app.registry import Artifact
from training.datasets.files import DATA
from training.fit.configuration import Config, ConfigError, first_error

_TRAINING = Path(__file__).resolve().parents[1]


def shipped_configs() -> dict[str, Path]:
    """Return the files of the shipped configurations by name."""
    return _toml_files("runs/configs")


def shipped_files(kind: str) -> dict[str, Path]:
    """Return the shipped "ablations" or "spaces" by the name of their configuration."""
    return _toml_files(f"research/configs/{kind}")


def _toml_files(folder: str) -> dict[str, Path]:
    return {path.stem: path for path in sorted((_TRAINING / folder).glob("*.toml"))}


def own_or_shipped(path: Path | None, config: Config, kind: str, option: str) -> Path:
    """Return the file of the user, or the shipped file of a kind for a configuration."""
    shipped = shipped_files(kind)
    if path is None and config.name not in shipped:
        available = f"(available for: {', '.join(shipped)})"
        raise ConfigError(
            f"{config.name} has no shipped {kind} {available}. Pass a TOML file with {option}"
        )
    return path or shipped[config.name]


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file. Raise ConfigError if it is missing or invalid."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"{path} does not exist") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path.name} is not TOML: {error}") from error


def config_path(reference: str) -> Path:
    """Return the file of a reference: a shipped name, a file, or a folder made by `init`."""
    path = shipped_configs().get(reference, Path(reference))
    return path / f"{path.resolve().name}.toml" if path.is_dir() else path


def data_folder(reference: str, config: Config, given: Path | None = None) -> Path:
    """Return `given`, the folder of a configuration file that names files, or `DATA`."""
    return given or (config_path(reference).parent if config.data.files else DATA)


def load_config(reference: str, *, seed: int | None = None) -> Config:
    """Read a configuration. Its entry `base` names a shipped one with the default entries."""
    path = config_path(reference)
    if not path.is_file():
        choice = f"pass a TOML file or one of {', '.join(shipped_configs())}"
        raise ConfigError(f"there is no configuration {reference!r}: {choice}")
    values = _with_base(path)
    if seed is not None:
        values.setdefault("training", {})["seed"] = seed
    return _validated(values, f"{path.name}:")


def _with_base(path: Path) -> dict[str, Any]:
    """Return the entries of a file, merged into those of its base."""
    values = read_toml(path)
    if (base := values.pop("base", None)) is None:
        return values
    if base not in shipped_configs():
        raise ConfigError(f"{path.name}: base must be one of {', '.join(shipped_configs())}")
    return _merged(_with_base(shipped_configs()[base]), values)


def _merged(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of both; an own entry replaces that of the base, but joins a section."""
    both = {
        name: _merged(value, own[name])
        for name, value in base.items()
        if isinstance(value, Mapping) and isinstance(own.get(name), Mapping)
    }
    return {**base, **own, **both}


def stored_config(artifact: Artifact) -> Config:
    """Return the configuration of a published model."""
    if "config" not in artifact.manifest.training:
        reference = "@".join(artifact.key)
        raise ConfigError(
            f"{reference} was adapted to a home: `python -m training adapt` measures and renews it"
        )
    return Config.model_validate(artifact.manifest.training["config"])


def _validated(values: Mapping[str, Any], title: str) -> Config:
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{title} {first_error(error)}") from error


def with_settings(config: Config, settings: Mapping[str, Any]) -> Config:
    """Return a configuration with new values of entries, such as "relations.epochs"."""
    values = config.model_dump()
    for name, value in settings.items():
        section, _, entry = name.partition(".")
        # The fields of the section; none if the configuration has no section of this name.
        entries = getattr(type(getattr(config, section, None)), "model_fields", {})
        if entry not in entries:
            choice = f"{section} has {', '.join(entries)}" if entries else "name it section.entry"
            raise ConfigError(f"there is no setting {name!r}: {choice}")
        values[section][entry] = value
    return _validated(values, f"the settings {dict(settings)} are invalid:")


def shortened(config: Config, factor: float) -> Config:
    """Return a configuration whose training has a share of the steps and epochs, at least one."""
    full = {"objects.steps": config.objects.steps, "relations.epochs": config.relations.epochs}
    return with_settings(config, {name: max(1, round(factor * x)) for name, x in full.items()})


def config_toml(config: Config) -> str:
    """Return the configuration as TOML text that `load_config` reads."""
    return sections_toml(config.model_dump(mode="json", exclude_none=True))


def sections_toml(values: Mapping[str, Any], reasons: Mapping[str, str] | None = None) -> str:
    """Return entries and sections as TOML, with `reasons` as comments above "section.entry"."""
    sections = {name: own for name, own in values.items() if isinstance(own, Mapping)}
    lines = [_entry(name, value) for name, value in values.items() if name not in sections]
    for section, entries in sections.items():
        lines += ["", f"[{section}]"]
        for name, value in entries.items():
            if reason := (reasons or {}).get(f"{section}.{name}"):
                lines.append(f"# {reason}")
            lines.append(_entry(name, value))
    return "\n".join(lines) + "\n"


def _entry(name: str, value: Any) -> str:
    """Return the TOML line of an entry, with a mapping as an inline table."""
    if isinstance(value, Mapping):
        entries = ", ".join(_entry(json.dumps(key), entry) for key, entry in value.items())
        return f"{name} = {{ {entries} }}"
    # JSON and TOML write all other values in the same way.
    return f"{name} = {json.dumps(value, ensure_ascii=False)}"
