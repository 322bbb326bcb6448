"""Two commands: `init` proposes a configuration for your scenes, `example` generates scenes."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer
from rich.console import Console

from app.registry import RegistryError
from training.datasets import AnnotatedScene, DatasetError, generate_rooms
from training.datasets.jsonl import scan_jsonl, write_jsonl
from training.datasets.readers import READERS, guess_format
from training.datasets.rooms import DOMAINS
from training.datasets.vocabulary import vocabulary_json
from training.domain.proposal import propose
from training.domain.proposal_report import as_dict, show
from training.evaluation.report import write_whole
from training.fit.configuration import ConfigError, is_file, source_name
from training.runs.config_files import shipped_configs
from training.runs.example_scenes import examples_json

# Maximum number of invalid lines that are printed. Further invalid lines are only counted.
BAD_LINES = 20

StorePath = Annotated[str, typer.Option("--store", help="folder of the model store")]
STORE = "model_store"

console = Console()


def init(
    name: Annotated[
        str,
        typer.Argument(
            help="name of the model, such as my-lab: words of a-z and 0-9, joined by hyphens; "
            "capitals, underscores, dots and spaces are refused"
        ),
    ],
    files: Annotated[list[Path], typer.Argument(help="files with the scenes of one domain")],
    output: Annotated[
        Path | None, typer.Option(help="output folder; default: a folder named like the model")
    ] = None,
    format_: Annotated[
        str | None,
        typer.Option("--format", help=f"{', '.join(READERS)}; default: derived from file names"),
    ] = None,
    terms: Annotated[str, typer.Option(help="terms of use of the scenes (model card)")] = "",
    report: Annotated[Path | None, typer.Option("--json", help="file for a JSON report")] = None,
    force: Annotated[bool, typer.Option("--force", help="overwrite existing files")] = False,
) -> None:
    """Analyse your scenes, and propose a vocabulary and a training configuration.

    The command writes NAME.toml, vocabulary.json and examples.json (scenes for the visual page)
    into the output folder. You can edit these files. The command overwrites existing files only
    with --force.
    """
    folder = Path(name) if output is None else output
    try:
        _check_name(name)
        targets = [folder / file for file in (f"{name}.toml", "vocabulary.json", "examples.json")]
        with console.status("reading scenes"):
            scenes_of = {file: _read(file, format_) for file in files}
        sources, copies = _sources_and_copies(folder, scenes_of)
        _require_new([*targets, *copies], force=force)
        all_scenes = [scene for scenes in scenes_of.values() for scene in scenes]
        with console.status("analysing scenes"):
            proposal = propose(name, all_scenes, sources, terms=terms)
    except (ConfigError, DatasetError, ValueError) as error:
        fail(error)
    folder.mkdir(parents=True, exist_ok=True)
    for path, scenes in copies.items():
        write_jsonl(scenes, path)
    vocabulary, examples = vocabulary_json(proposal.vocabulary), examples_json(proposal.examples)
    for path, text in zip(targets, (proposal.toml(), vocabulary, examples), strict=True):
        write_whole(path, text)
    if report is not None:
        write_whole(report, json.dumps(as_dict(proposal), indent=1, ensure_ascii=False) + "\n")
    show(proposal, console)
    lines = [
        f"\nwritten: {', '.join(map(str, [*targets, *copies]))}",
        f"next: check these files, then run  python -m training train {folder}",
    ]
    if folder.resolve().name != name:
        lines.append(f"      (the configuration is {targets[0]})")
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def _check_name(name: str) -> None:
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        raise ConfigError(
            f"the model name is {name!r}; use lower-case words and digits, joined by hyphens, "
            "such as my-lab"
        )
    if name in shipped_configs():
        raise ConfigError(f"{name} is the name of a shipped configuration; choose another name")


def _read(path: Path, format_: str | None) -> list[AnnotatedScene]:
    """Read the scenes of a file, or print all invalid lines of a JSONL file and exit."""
    if format_ is not None and format_ not in READERS:
        raise ConfigError(f"unknown format {format_!r}: use one of {', '.join(READERS)}")
    format_ = format_ or guess_format(path)
    lines = list(scan_jsonl(path) if format_ == "jsonl" else READERS[format_](path))
    errors = [line for line in lines if isinstance(line, DatasetError)]
    if errors:
        n = len(errors)
        count = "1 line is not a scene" if n == 1 else f"{n} lines are not scenes"
        console.print(f"[red]error:[/red] {count}; no file was written", soft_wrap=True)
        for error in errors[:BAD_LINES]:
            console.print(f"  {path.name}, {error.where}: {error.problem}", markup=False)
        if n > BAD_LINES:
            console.print(f"  and {n - BAD_LINES} more")
        raise typer.Exit(1)
    if not lines:
        raise DatasetError(path, "", "the file contains no scene")
    return [line for line in lines if isinstance(line, AnnotatedScene)]


def _sources_and_copies(
    folder: Path, scenes_of: dict[Path, list[AnnotatedScene]]
) -> tuple[list[str], dict[Path, list[AnnotatedScene]]]:
    """Return the paths of the scene files relative to the folder, and the files to copy.

    A file is copied under a new name if its own name does not determine the format. The second
    result maps the path of each copy to its scenes.
    """
    sources: list[str] = []
    copies: dict[Path, list[AnnotatedScene]] = {}
    for file, scenes in scenes_of.items():
        try:
            guess_format(file)
            sources.append(Path(os.path.relpath(file, folder)).as_posix())
        except DatasetError:
            sources.append(f"{source_name(file.name) if is_file(file.name) else file.name}.jsonl")
            copies[folder / sources[-1]] = scenes
    return sources, copies


def _require_new(paths: Sequence[Path], *, force: bool) -> None:
    existing = [str(path) for path in paths if path.exists()]
    if existing and not force:
        raise ConfigError(
            f"{' and '.join(existing)} would be overwritten: use --force, or choose another folder "
            "with --output"
        )


def fail(error: Exception) -> NoReturn:
    """Print the error, without the code of a registry error, and exit with code 1."""
    reason = error.reason if isinstance(error, RegistryError) else error
    console.print(f"[red]error:[/red] {reason}", soft_wrap=True)
    raise typer.Exit(1) from None


def example(
    file: Annotated[Path, typer.Argument(help="output file, such as scenes.jsonl")],
    domain: Annotated[
        Literal["homes", "workplaces"],
        typer.Option(
            help="homes: furnished rooms; workplaces: laboratories, workshops, storerooms"
        ),
    ] = "workplaces",
    scenes: Annotated[int, typer.Option(min=1, help="number of scenes")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="random seed")] = 0,
) -> None:
    """Generate example scenes of a domain, and write them as JSON lines.

    With the same seed, a larger number of scenes only adds scenes after the existing scenes.
    """
    if file.exists():
        fail(ConfigError(f"{file} already exists; choose another output file"))
    file.parent.mkdir(parents=True, exist_ok=True)
    write_jsonl(generate_rooms(scenes, seed, DOMAINS[domain]), file)
    console.print(f"{scenes} generated scenes of {domain}: {file}", soft_wrap=True)
