"""`python -m training adapt`: a version of a model for one home, from the scenes of its robot."""

from __future__ import annotations

import importlib.metadata
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from pydantic import JsonValue

from app.model import Calibration, SceneModel
from app.registry import (
    DEFAULT_STORE,
    Artifact,
    DataSource,
    Description,
    Metric,
    RegistryError,
    Store,
    VocabularyEntry,
)
from app.registry.references import AliasTarget
from training.datasets import AnnotatedScene, DatasetError
from training.datasets.console import console, print_lines
from training.datasets.records import digest_of
from training.datasets.vocabulary import left_out_line
from training.domain.adaptation import FEWEST, Adapted, Measured, adapted
from training.domain.home import MAX_ALARMS, MAX_CLASSES, Home, confirmed_scene
from training.domain.look import of_convention
from training.domain.material import read_material
from training.domain.own_words import JUDGED
from training.domain.terminal import ROWS, StorePath, fail, print_finding
from training.evaluation.metrics import Ratio
from training.fit.configuration import ConfigError
from training.runs.example_scenes import choose_examples
from training.runs.publish import publish_rounded

_TASK = "Home"
_NOTHING = (
    "nothing was published: the weights stay, and no confirmed scene has an object that the model "
    f"reports. Record at least {FEWEST} scenes, or confirm scenes on the page"
)
_LIBRARIES = ("numpy", "torch")
_NAMED = 3  # listed scenes of an object that is left out


def adapt_command(
    model: Annotated[str, typer.Argument(help="model to adapt: an alias, name or name@version")],
    files: Annotated[
        list[Path],
        typer.Argument(
            help="recorded scenes of one home; a later file corrects earlier scenes. A table *.csv "
            "with room_type and label tells what belongs where"
        ),
    ],
    name: Annotated[str, typer.Option("--name", help="name of the home's model")] = "home",
    store: StorePath = DEFAULT_STORE,
    promote: Annotated[
        bool, typer.Option("--promote", help="point the alias `default` at the new version")
    ] = False,
    alias: Annotated[
        str | None, typer.Option(help="with --promote: move this alias instead of `default`")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="random seed")] = 0,
) -> None:
    """Adapt a model to the home where the scenes were recorded, and publish it as NAME.

    A robot records scenes with `Client(record=...)`, and a person confirms scenes on the web page
    (docs/own-home.md). An unconfirmed scene does not teach the objects that the model reports as
    outliers there. Each place of a written table is a confirmed scene.

    From 20 recorded scenes on, the weights change. The command compares old and new weights on
    scenes that the fit did not see, and refuses weights that are not certainly better. With fewer
    scenes, the new version only stops to report the objects of confirmed scenes. If nothing can be
    learnt, no version is published, and the exit code is 3.
    """
    torch.set_num_threads(1)
    try:
        if alias is not None and not promote:
            raise ConfigError("--alias belongs to --promote")
        models = Store(store)
        parent = _parent(models, model, name)
        version = _next_version(models, name)
        models.require_new(name, version)
        material = read_material(files, recorded=True)
        recorded, places = _corrected(material.files), material.places
        with console.status("reading the scenes") as status:
            home = Home.of(parent.model, recorded, places)
            _print_home(home, parent)
            print_lines(*filter(None, [left_out_line(material.left_out, ROWS)]))
            if (finding := of_convention(recorded)).count:
                print_finding(finding)
            result = adapted(home, seed=seed, progress=status.update)
        _print_result(home, result)
        if result.model is None:
            print_lines(_NOTHING)
            raise typer.Exit(3)
        written = [*map(confirmed_scene, places)]
        description = _description(home, parent, result, recorded, written, name, version, seed)
        published = publish_rounded(models, description, result.model)
        _print_next(models, store, published, alias or "default" if promote else None)
    except (ConfigError, DatasetError, RegistryError, ValueError) as error:
        fail(error)


def _parent(store: Store, reference: str, name: str) -> Artifact:
    """Load the model to adapt. An adapted model stands for the model that it was adapted from."""
    artifact = store.load(*store.resolve(reference))
    origin = artifact.manifest.training.get("parent")
    if isinstance(origin, dict):
        artifact = store.load(str(origin["name"]), str(origin["version"]))
        parent = "@".join(artifact.key)
        console.print(f"{reference} is itself adapted; adapting its parent {parent} again")
    if artifact.manifest.name == name:
        raise ConfigError(f"--name {name} is the name of the model itself: choose another name")
    return artifact


def _next_version(store: Store, name: str) -> str:
    """Return the version after the newest one: 1.0.0, 1.1.0, 1.2.0 ..."""
    versions = store.versions(name)
    if not versions:
        return "1.0.0"
    major, minor, _ = versions[-1].split(".")
    return f"{major}.{int(minor) + 1}.0"


def _corrected(files: Iterable[Sequence[AnnotatedScene]]) -> list[AnnotatedScene]:
    """Join the scenes of one home. A later scene replaces an earlier one with its id.

    Scenes without a group, the hour of a recording, have their file as group.
    """
    scenes = {
        scene.scene_id: replace(scene, group=f"file {number}") if own_group else scene
        for number, file in enumerate(files)
        for scene in file
        for own_group in (scene.group == scene.scene_id,)
    }
    homes = sorted({scene.source for scene in scenes.values()})
    if len(homes) > 1:
        raise ConfigError(f"the scenes come from several homes ({', '.join(homes)}): adapt each")
    return list(scenes.values())


def _print_home(home: Home, parent: Artifact) -> None:
    """Print the numbers of scenes, new words, and objects without influence."""
    lines = [
        f"{home.recorded} recorded scenes; {len(home.scenes) - len(home.written)} distinct scenes, "
        f"{home.confirmed} of these confirmed; model {'@'.join(parent.key)}"
    ]
    if n := len(home.written):
        lines.append(f"{n} written place{'s' if n > 1 else ''}, each as one confirmed scene")
    if home.new_classes:
        lines.append(
            f"new classes, judged after {JUDGED} scenes: {_listed(home.new_classes, ROWS)}"
        )
    if home.new_rooms:
        lines.append(f"new room types: {_listed(home.new_rooms, ROWS)}")
    if home.unlearnt:
        lines.append(f"beyond the limits of a home: {_listed(home.unlearnt, ROWS)}")
    if home.too_large:
        lines.append(
            f"left out, because a scene is one room with at most {MAX_CLASSES} classes: "
            f"{_listed(home.too_large, _NAMED)}"
        )
    if home.doubted:
        lines.append(
            f"taken as unconfirmed, because they have more than {MAX_ALARMS} alarms: "
            f"{_listed(home.doubted, _NAMED)}"
        )
    if home.left_out:
        lines.append(
            "left out, because no person has confirmed them. Confirm their scenes on the page if "
            "they belong there:"
        )
        most = sorted(home.left_out.items(), key=lambda entry: -len(entry[1]))[:ROWS]
        lines += (f"  {label} ({len(ids)}): {_listed(ids, _NAMED)}" for label, ids in most)
    print_lines(*lines)


def _listed(words: Sequence[str], most: int) -> str:
    """Return the first words, and the number of the others."""
    more = f", and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + more


def _print_result(home: Home, result: Adapted) -> None:
    """Print the comparison in folds, the objections, and the exceptions."""
    lines = []
    if (measured := result.measured) is None:
        lines.append(
            f"the weights stay: fewer than {FEWEST} distinct recorded scenes with two known objects"
        )
    else:
        alarms, rank = measured.alarms.mean(0), measured.rank.mean(0)
        lines += [
            f"on {len(measured.alarms)} scenes of folds that the fit did not see:",
            f"  scenes with an alarm      {alarms[0]:6.1%} → {alarms[1]:6.1%}   (right or false)",
            f"  MRR of a missing object   {rank[0]:6.3f} → {rank[1]:6.3f}",
            f"  t of the gain             {measured.t:6.1f}            (above 2: certain)",
        ]
    if result.objections:
        lines.append(f"the weights stay: {'; '.join(result.objections)}")
    if result.exceptions:
        counts = [f"{label} ({n})" for label, n in result.exceptions.most_common()]
        lines.append(
            f"{len(counts)} exception{'s' if len(counts) > 1 else ''}, never reported in any room "
            f"from now on: {_listed(counts, ROWS)} (confirmed scenes)"
        )
    labels = home.parent.vocabulary.labels
    written = {labels[c] for k in home.written for c in home.scenes[k].classes.tolist()}
    if quiet := sorted(written - set(result.exceptions)):
        lines.append(f"written things that need no exception: {_listed(quiet, ROWS)}")
    if result.refused:
        lines.append(f"exceptions are refused: {'; '.join(result.refused)}")
    if result.relations:
        lines.append(f"usual from now on: {_listed(result.relations, ROWS)} (confirmed scenes)")
    if result.places:
        lines.append(f"{result.places} relations repeat, and count in the usual places")
    if result.numbers:
        lines.append(f"usual numbers of: {_listed(result.numbers, ROWS)}")
    print_lines(*lines)


def _description(
    home: Home,
    parent: Artifact,
    result: Adapted,
    recorded: Sequence[AnnotatedScene],
    written: Sequence[AnnotatedScene],  # of written places
    name: str,
    version: str,
    seed: int,
) -> Description:
    """Return the description of the adapted model. Its terms are those of the parent."""
    manifest, model = parent.manifest, result.model or parent.model
    own = next((scene.source for scene in recorded if scene.source != "jsonl"), name)
    sources = [
        DataSource(
            source=source, scenes=len(part), digest=digest_of(part), terms=terms,
            research_only=False, written=part is written,
        )
        for source, part, terms in (
            (own, recorded, "recorded in the home"),
            (f"{own}, written", written, "written by a person of the home"),
        )
        if part
    ]  # fmt: skip
    origin: JsonValue = {"name": parent.key[0], "version": parent.key[1], "digest": parent.digest}
    return Description(
        name=name,
        version=version,
        created=datetime.now(UTC).replace(microsecond=0),
        spec=model.spec.to_dict(),
        vocabulary=VocabularyEntry.of(model.vocabulary, model.spec.A, manifest.vocabulary.profiles),
        calibration=_calibration(home, model),
        training={
            "parent": origin,
            "seed": seed,
            "confirmed": home.confirmed,
            "recorded": len(recorded),
            "written": len(written),
        },
        data=(*manifest.data, *sources),
        metrics=tuple(_metrics(result.measured, own)),
        terms=manifest.terms,
        libraries={library: importlib.metadata.version(library) for library in _LIBRARIES},
        examples=choose_examples([*recorded, *written], model.vocabulary) or manifest.examples,
    )


def _calibration(home: Home, model: SceneModel) -> Calibration:
    """Return the calibration, with the popularity of the new classes in the home."""
    calibration, old = model.calibration, home.parent_classes  # new classes follow the old ones
    if not calibration.popularity:
        return calibration
    count, scenes = home.tensors.v.sum(0)[old:].double().numpy(), len(home.scenes)
    log_odds = np.log((count + 0.5) / (scenes - count + 0.5))
    popularity = (*calibration.popularity[:old], *np.round(log_odds, 4).tolist())
    return calibration.model_copy(update={"popularity": popularity})


def _metrics(measured: Measured | None, source: str) -> Iterable[Metric]:
    """Yield the metrics of the folds, for the parent and for the adapted weights."""
    if measured is None:
        return
    tables = {"scenes with an alarm": measured.alarms, "MRR, one removed": measured.rank}
    for name, table in tables.items():
        for column, side in enumerate(("parent", "adapted")):
            figure = Ratio.of_scenes(table[:, column]).figure()
            yield Metric(
                task=_TASK, source=source, metric=f"{name}, {side}",
                value=figure.value, low=figure.low, high=figure.high, n=len(table),
            )  # fmt: skip


def _print_next(store: Store, root: str, artifact: Artifact, alias: str | None) -> None:
    """Print the published version. Move the alias, or print how to move it."""
    reference = "@".join(artifact.key)
    console.print(f"published {reference}, digest {artifact.digest[:12]}")
    if alias is None:
        command = f"python -m app.registry alias default {reference} --store {shlex.quote(root)}"
        line = f"ask it by its name ({artifact.key[0]}), or serve it as default: {command}"
    else:
        before = store.aliases().get(alias)
        store.set_alias(alias, AliasTarget.of(reference), expected=before)
        line = f"promoted: {alias} → {reference}"
        if before is not None:
            command = f"python -m app.registry alias {alias} {before} --store {shlex.quote(root)}"
            line += f"; to roll back: {command}"
    print_lines(line)
