"""The command line of training, with commands such as init, train, compare, publish and adapt.

A new training run replaces the last finished run of its folder when it ends. Ctrl-C keeps the last
finished run.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from app.model import SceneModel
from app.registry import DEFAULT_STORE, Artifact, RegistryError, Store
from app.registry.references import AliasTarget
from training.datasets import DatasetError
from training.datasets.console import console, print_lines, print_marked
from training.datasets.files import DATA
from training.domain.adapt_command import adapt_command
from training.domain.candidates import of_run
from training.domain.compare import MARGIN, compare, compare_command, show
from training.domain.evaluate_command import evaluate_command
from training.domain.gate import NEW, measure_usefulness, served_model
from training.domain.init_command import example, init
from training.domain.look import outside_vocabulary
from training.domain.terminal import Display, StorePath, fail, next_steps
from training.evaluation.report import Progress
from training.fit.configuration import Config, ConfigError
from training.fit.trainer import Trainer
from training.research.benchmark import ablate, benchmark
from training.research.tune import tune
from training.research.words import words
from training.runs.config_files import data_folder, load_config, with_settings
from training.runs.example_scenes import accepted_examples, read_examples
from training.runs.folder import FinishedRun, RunError, load_run, save_run
from training.runs.pipeline import SplitScenes, prepare
from training.runs.publish import RefusedError, publish_run, refit, rename
from training.seed.command import seed as seed_command

app = typer.Typer(
    rich_markup_mode="markdown", add_completion=False, no_args_is_help=True, help=__doc__
)
app.command()(example)
app.command()(init)
app.command(name="adapt")(adapt_command)
app.command()(tune)
app.command(name="compare")(compare_command)
app.command()(benchmark)
app.command()(ablate)
app.command()(words)
app.command(name="evaluate")(evaluate_command)
app.command(name="seed")(seed_command)

Data = Annotated[
    Path | None,
    typer.Option(
        "--data",
        help="folder with the scene files; default: the folder of your configuration file, or "
        f"{DATA} for a shipped configuration (docs/training.md says what belongs there)",
    ),
]
StoredData = Annotated[
    Path | None,
    typer.Option(
        "--data",
        help="folder with the scene files. For a stored model of your own scenes, pass the folder "
        f"of its configuration file; default: {DATA}, or for a run, the folder of its training",
    ),
]
_ALIAS = "`python -m app.registry alias` moves an alias without a comparison"


@app.command()
def train(
    configuration: Annotated[str, typer.Argument(help="a TOML file, or a shipped configuration")],
    data: Data = None,
    runs: Annotated[Path, typer.Option(help="folder of the training runs")] = Path("runs"),
    seed: Annotated[int | None, typer.Option(help="seed, overrides the configuration")] = None,
    final: Annotated[
        bool,
        typer.Option(
            "--final",
            help="train on 90 % of all scenes, test scenes included, and calibrate on 10 %; "
            "--publish then copies the test results of the finished run without --final",
        ),
    ] = False,
    publish: Annotated[str | None, typer.Option(help="publish the run as this version")] = None,
    store: StorePath = DEFAULT_STORE,
) -> None:
    """Train a configuration. With --publish, also calibrate, evaluate and publish the model."""
    try:
        config = load_config(configuration, seed=seed)
        if publish is not None:
            Store(store).require_new(config.name, publish)
        root = data_folder(configuration, config, data)
        folder = runs / config.name / f"seed-{config.training.seed}"
        measured = None
        if final:
            if publish is not None:
                with console.status("reading and encoding scenes"):
                    measured = load_run(folder), prepare(config, root)
            config = with_settings(config, {"data.split": "final"})
            folder = folder.with_name(f"final-{folder.name}")
        scenes = _prepare(config, root)
        trainer = Trainer(config, scenes.training_data())
        console.print(f"{config.name}: {trainer.machine.parameter_count:,} weights")
        with Display(trainer) as display:
            result = trainer.run(display.progress)
        save_run(folder, config, result, data=root, scenes=scenes.digest)
        display.summarise(result.seconds, folder)
        if publish is None and not final:
            next_steps(folder)
        if publish is not None:
            artifact = _publish(load_run(folder), scenes, Store(store), publish, measured=measured)
            _print_published(artifact, store)
    except RefusedError as error:
        _exit_refused(error)
    except (*(ConfigError, DatasetError, RegistryError, RunError), FloatingPointError) as error:
        fail(error)
    except KeyboardInterrupt:
        console.print("stopped; finished runs and published versions stay as they were")
        raise typer.Exit(130) from None


@app.command()
def publish(
    folder: Annotated[
        str,
        typer.Argument(
            help="folder of a finished training run; or name@version of a published model, whose "
            "statistics are fitted again"
        ),
    ],
    version: Annotated[str, typer.Argument(help="number of the new version, such as 1.0.0")],
    data: StoredData = None,
    store: StorePath = DEFAULT_STORE,
    promote: Annotated[
        bool,
        typer.Option(
            "--promote",
            help="point an alias at the new version, unless the new version is useless or worse "
            "than the served version",
        ),
    ] = False,
    alias: Annotated[
        str | None, typer.Option(help="with --promote: move this alias instead of `default`")
    ] = None,
    margin: Annotated[
        float, typer.Option(min=0, help="with --promote: maximum accepted loss of a metric")
    ] = MARGIN,
    even_if_worse: Annotated[
        bool, typer.Option("--even-if-worse", "--force", help="publish even a refused version")
    ] = False,
    names: Annotated[
        bool, typer.Option("--names", help="with name@version: renew the names of classes only")
    ] = False,
) -> None:
    """Calibrate, evaluate and publish a finished run, or refit the statistics of a version.

    With name@version, the command fits the offsets, the counts of instances, the alarm lines and
    the limits of generated scenes again. The new version keeps the weights and the other
    calibration and metrics of the old version. For a version of `train --final`, the shares of
    flagged intruders, of alarms and of refused rooms are left out, because its weights know the
    test scenes. With --names, the new version has today's names of its classes, and all else of the
    old version.

    The command asks the model about untouched validation scenes, and refuses a model that certainly
    raises more alarms than its sensitivities promise. A refused version is not published, and the
    exit code is 3.

    With --promote, the command also compares the new version with two baselines on the test scenes
    of the run: it must rank missing objects better than popularity, and not worse than EASE
    (co-occurrence). Then it compares the new version with the version that the alias serves, on
    test scenes that neither version was trained on. The command refuses the new version if the
    whole 95 % interval of the loss in a primary metric exceeds the margin, or if only the served
    version has results for relations.
    """
    try:
        if alias is not None and not promote:
            raise ConfigError(f"--alias belongs to --promote; {_ALIAS}")
        if "@" in folder and not Path(folder).is_dir():
            if promote:
                raise ConfigError(f"--promote compares training runs; {_ALIAS}")
            _publish_again(folder, data or DATA, store, version, names=names)
            return
        if names:
            raise ConfigError("--names renews a published version: give NAME@VERSION")
        run = load_run(Path(folder))
        models = Store(store)
        models.require_new(run.config.name, version)
        if promote and run.config.data.split == "final":
            raise ConfigError(
                f"{folder} is a final run without test scenes, so it cannot be compared; {_ALIAS}"
            )
        root = data or run.data_folder
        scenes = _prepare(run.config, root)
        accept = _print_accepted if even_if_worse else None
        if promote:
            _promote(run, scenes, root, models, version, alias or "default", margin, accept=accept)
        else:
            _print_published(_publish(run, scenes, models, version, accept=accept), store)
    except RefusedError as error:
        _exit_refused(error, "; --even-if-worse publishes the version all the same")
    except (RunError, ConfigError, DatasetError, RegistryError) as error:
        fail(error)


def _prepare(config: Config, data: Path) -> SplitScenes:
    """Read scenes and examples, and print their numbers and what is left out."""
    with console.status("reading and encoding scenes"):
        scenes = prepare(config, data)
    examples, reasons = accepted_examples(read_examples(config.examples, data), scenes.vocabulary)
    sizes = ", ".join(f"{len(part)} {name}" for name, part in scenes.parts.items())
    console.print(f"{len(scenes.vocabulary)} object classes; scenes: {sizes}")
    if line := outside_vocabulary(scene for part in scenes.parts.values() for scene in part):
        print_lines(line)
    for reason in reasons:
        print_marked("note:", "yellow", f"an example is left out: {reason}")
    return replace(scenes, examples=examples)


def _publish(
    run: FinishedRun, scenes: SplitScenes, store: Store, version: str, **options: Any
) -> Artifact:
    """Publish a run; `publish_run` has the options."""
    with console.status("publishing") as status:
        return publish_run(run, scenes, store, version, progress=status.update, **options)


def _print_accepted(reason: str) -> None:
    console.print(f"accepted by --even-if-worse: {reason}", soft_wrap=True)


def _exit_refused(error: RefusedError, remedy: str = "") -> NoReturn:
    print_marked("refused:", "red", str(error))
    console.print(f"nothing was published{remedy}")
    raise typer.Exit(3) from None


def _publish_again(reference: str, root: Path, store: str, version: str, *, names: bool) -> None:
    """Publish a stored model with new names, or with statistics from the scenes in `root`."""
    models = Store(store)
    name, old = models.resolve(reference)
    models.require_new(name, version)
    artifact = models.load(name, old)
    with console.status("publishing") as status:
        if names:
            artifact = rename(artifact, models, version)
        else:
            artifact = refit(artifact, root, models, version, progress=status.update)
    _print_published(artifact, store)


def _print_published(artifact: Artifact, unmoved: str | None = None) -> None:
    """Print the new version. If no alias moved in the store `unmoved`, print the next step."""
    reference = f"{artifact.manifest.name}@{artifact.manifest.version}"
    console.print(f"published {reference}, digest {artifact.digest[:12]}")
    if unmoved is not None:
        command = f"python -m app.registry alias default {reference} --store {shlex.quote(unmoved)}"
        console.print(f"no alias moved; to serve it as default: {command}", soft_wrap=True)


def _promote(
    run: FinishedRun,
    scenes: SplitScenes,
    root: Path,
    store: Store,
    version: str,
    alias: str,
    margin: float,
    *,
    accept: Callable[[str], None] | None,
) -> None:
    """Publish the version and point the alias at it, unless the gate refuses the version."""
    served = served_model(store, alias)

    def judge(model: SceneModel, say: Progress) -> list[str]:
        """Print the comparisons with baselines and the served model; return the objections."""
        useful = measure_usefulness(model, scenes.training_data(), say=say)
        for line in useful.lines():
            console.print(line, highlight=False)
        reasons = useful.objections()
        if served.candidate is not None and (accept or not reasons):
            try:
                new = of_run(NEW, run, scenes, model, root)
                comparison = compare(new, served.candidate, root, say=say)
                show(comparison, margin)
                reasons += comparison.objections(margin)
            except ConfigError as error:
                if accept is None:
                    raise
                console.print(f"the versions were not compared: {error}", soft_wrap=True)
        return reasons

    artifact = _publish(run, scenes, store, version, judge=judge, accept=accept)
    if served.note:
        console.print(served.note, soft_wrap=True)
    _print_published(artifact)
    # `expected` makes the change fail if another process changed the alias during the comparison.
    target = AliasTarget(name=artifact.manifest.name, version=version)
    store.set_alias(alias, target, expected=served.target)
    change = f", before {served.target}" if served.target is not None else ""
    console.print(f"promoted: {alias} → {target}{change}", soft_wrap=True)
    command = f"SCENE_STORE={shlex.quote(str(store.root))} SCENE_PORT=8055 python -m app"
    print_lines(f"next: {command}")
