"""Two commands: `init` proposes a configuration for your material, `example` generates scenes."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from training.datasets import DatasetError, generate_rooms
from training.datasets.console import console, print_lines, print_marked
from training.datasets.files import write_whole
from training.datasets.jsonl import write_jsonl
from training.datasets.rooms import DOMAINS
from training.datasets.vocabulary import left_out_line, vocabulary_json
from training.domain.look import Label
from training.domain.material import read_material
from training.domain.proposal import Proposal, propose
from training.domain.terminal import ROWS, fail, listing, print_finding
from training.domain.update import PROPOSED, proposed_json, update
from training.fit.configuration import ConfigError
from training.runs.config_files import shipped_configs
from training.runs.example_scenes import examples_json


def init(
    name: Annotated[
        str,
        typer.Argument(
            help="name of the model, such as my-lab: words of a-z and 0-9, joined by hyphens; "
            "capitals, underscores, dots and spaces are refused"
        ),
    ],
    files: Annotated[
        list[Path],
        typer.Argument(help="files with the scenes of one domain, and written inventories (*.csv)"),
    ],
    output: Annotated[
        Path | None, typer.Option(help="output folder; default: a folder named like the model")
    ] = None,
    terms: Annotated[str, typer.Option(help="terms of use of the files (model card)")] = "",
    force: Annotated[bool, typer.Option("--force", help="overwrite existing files")] = False,
    extend: Annotated[
        bool, typer.Option("--update", help="add new files and classes, and keep your edits")
    ] = False,
) -> None:
    """Analyse your scenes or written inventories, and propose a vocabulary and a configuration.

    An inventory is a table of the things in your kinds of places (docs/your-place.md).

    The command writes NAME.toml, vocabulary.json and examples.json (scenes for the visual page)
    into the output folder. You can edit these files. The command overwrites existing files only
    with --force.

    With --update, the command adds new files to the sources, and their frequent labels to the end
    of the vocabulary. Classes that you removed stay removed. proposed.json records the names of
    all proposals for this purpose.
    """
    folder = Path(name) if output is None else output
    names = (f"{name}.toml", "vocabulary.json", "examples.json", PROPOSED)
    targets = [folder / file for file in names]
    try:
        _check_name(name)
        if extend:
            if force or terms:
                option = "--force" if force else "--terms"
                raise ConfigError(f"--update keeps your files, so {option} cannot be used with it")
            _update(name, folder, files)
            return
        with console.status("reading the files"):
            material = read_material(files)
        existing = [str(path) for path in targets if path.exists()]
        if existing and not force:
            raise ConfigError(
                f"{' and '.join(existing)} would be overwritten: use --force, or choose another "
                "folder with --output"
            )
        sources = [Path(os.path.relpath(file, folder)).as_posix() for file in files]
        with console.status("analysing the files"):
            proposal = propose(name, material, sources, terms=terms)
    except (ConfigError, DatasetError, ValueError) as error:
        fail(error)
    folder.mkdir(parents=True, exist_ok=True)
    texts = (
        proposal.toml(),
        vocabulary_json(proposal.vocabulary),
        examples_json(proposal.examples),
        proposed_json(proposal.vocabulary.objects, proposal.vocabulary.room_types),
    )
    for path, text in zip(targets, texts, strict=True):
        write_whole(path, text)
    written = "of written things or " if material.places else ""
    _show(proposal, f"classes {written}with at least {proposal.minimum} mentions")
    # With written places, the next command also publishes the model.
    lines = _next(name, folder, promoted=not material.places)
    print_lines("", f"written: {', '.join(map(str, targets))}", *lines)


def _update(name: str, folder: Path, files: Sequence[Path]) -> None:
    """Extend the proposal in a folder, and report what was added and what was kept."""
    with console.status("reading and analysing scenes"):
        result = update(name, folder, files)
    for path, text in result.files.items():
        write_whole(path, text)
    _show(result.proposal, "classes in the vocabulary")
    title = f"new classes with at least {result.proposal.minimum} mentions:"
    lines = listing(title, _mentions(result.added)) or ["no new classes"]
    lines += listing("new room types:", result.rooms)
    lines += listing("removed earlier, and not added again:", _mentions(result.removed))
    lines += listing("new sources:", result.sources)
    kept = "the settings" if result.sources else f"{name}.toml"
    print_lines(
        *lines,
        "",
        f"written: {', '.join(map(str, result.files)) or 'nothing'}",
        f"kept as they are: the earlier classes, {kept} and the examples",
        *_next(name, folder, promoted=not result.proposal.material.places),
    )


def _next(name: str, folder: Path, *, promoted: bool = True) -> list[str]:
    """Return the next command; without a promotion, it also publishes the model."""
    publish = "" if promoted else " --publish 1.0.0 --store my-store"
    lines = [f"next: check these files, then run  python -m training train {folder}{publish}"]
    if folder.resolve().name != name:
        lines.append(f"      (the configuration is {folder / f'{name}.toml'})")
    return lines


def _mentions(labels: Sequence[Label]) -> list[str]:
    return [f"{label.name} ({label.mentions})" for label in labels]


def _check_name(name: str) -> None:
    """Raise ConfigError if a model cannot have this name."""
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        raise ConfigError(
            f"the model name is {name!r}; use lower-case words and digits, joined by hyphens, "
            "such as my-lab"
        )
    if name in shipped_configs():
        raise ConfigError(f"{name} is the name of a shipped configuration; choose another name")


def _show(proposal: Proposal, classes: str) -> None:
    """Print the facts about the scenes, joined labels, and what the user must check."""
    facts = proposal.facts
    least, mean, most = facts.objects_per_scene
    rooms = ", ".join(f"{room} {count}" for room, count in list(facts.rooms.items())[:ROWS])
    shares = ", ".join(f"{name} {share:.0%}" for name, share in facts.annotated.items())
    lines = [
        *proposal.written_lines(),
        f"{facts.scenes} scenes in {facts.groups} groups, with {least} to {most} objects each "
        f"({mean:.1f} on average)",
        f"room types: {rooms or 'none'}",
        f"scenes with: {shares}",
        f"{len(proposal.vocabulary)} {classes}; they cover {proposal.coverage:.1%} of the objects",
    ]
    joined, kinds, renamed = proposal.read_otherwise()
    title = "joined with a class by built-in synonyms; vocabulary.json has the classes:"
    lines += listing(title, joined)
    lines += listing("kinds, which share weights with the broader class:", kinds)
    lines += listing("room types that have another name in answers:", renamed)
    lines += listing("labels without a class:", _mentions(proposal.dropped))
    lines += filter(None, [left_out_line(proposal.material.left_out, ROWS)])
    print_lines(*lines)
    console.print("Please check:" if facts.findings else "no contradictions found")
    for finding in facts.findings:
        print_finding(finding)
    if proposal.warning:
        print_marked("warning:", "yellow", proposal.warning)


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
