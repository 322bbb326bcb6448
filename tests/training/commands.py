"""`python -m training` in this process, and the configuration of a small machine."""

from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from training.cli import app
from training.fit.configuration import Config
from training.runs.config_files import config_toml, data_folder, load_config, with_settings
from training.runs.pipeline import SplitScenes, prepare


def invoke(*arguments: object, code: int = 0) -> str:
    """Run a command that must end with `code`, and return its output in one line."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return " ".join(result.output.split())


def init(*files: Path, folder: Path, name: str = "", code: int = 0, options: Any = ()) -> str:
    """Propose a configuration for files. By default, the model has the name of the folder."""
    return invoke("init", name or folder.name, *files, "--output", folder, *options, code=code)


def prepared(folder: Path) -> SplitScenes:
    """The scenes of the configuration in a folder."""
    config = load_config(str(folder))
    return prepare(config, data_folder(str(folder), config))


def small_config(name: str = "rooms-triway", variant: str = "triway", **data: Any) -> Config:
    """A machine on 60 generated rooms."""
    return Config.model_validate(
        {
            "name": name,
            "data": {"sources": ["rooms"], "vocabulary": "rooms", "rooms": 60, **data},
            "machine": {"variant": variant, "units": 3, "states": 3, "K": 2, "N": 32},
            "objects": {"steps": 200, "batch_size": 32, "chains": 16},
            "relations": {"epochs": 2, "batch_size": 16},
        }
    )


def write_config(path: Path, config: Config, settings: dict[str, Any] | None = None) -> Path:
    """Write a configuration with changed settings, such as "objects.steps"."""
    path.write_text(config_toml(with_settings(config, settings or {})))
    return path
