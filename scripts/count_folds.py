"""Cross-validate the statistics of counts of a model: is the expected count the better one?

The groups of near-duplicate scenes are divided into five random folds. For each fold, the
statistics are fitted to the other folds, of which each eighth group is for validation. Then the
task of `training.evaluation.counts` measures the fold with four random parts of each scene. The
statistics do not depend on the weights of the model, so its training scenes can be test scenes.

Run as `python -m scripts.count_folds --model NAME --data FOLDER`. `python -m training fetch` says
what belongs into the folder.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import torch

from app.registry import Artifact, Store, load_model_set
from training.batches import SceneTensors, scene_tensors
from training.config import DATA, Config
from training.counts import fit_counts
from training.datasets import EncodedScene, annotated_classes
from training.evaluation.counts import METRICS, counts_task
from training.evaluation.metrics import Ratio
from training.evaluation.setting import Contender, Setting
from training.pipeline import read_sources, split_and_encode

FOLDS: Final = 5
PARTS: Final = 4
_VALIDATION: Final = 8


class Fold(NamedTuple):
    """The scenes of a fold. A group is in one of the three lists."""

    train: list[EncodedScene]
    validation: list[EncodedScene]
    test: list[EncodedScene]


def folds(scenes: Sequence[EncodedScene], seed: int = 0) -> Iterator[Fold]:
    """Yield the folds. Each group is in the test scenes of one fold."""
    groups = sorted({scene.group for scene in scenes})
    order = np.random.default_rng(seed).permutation(len(groups)).tolist()
    place = dict(zip(groups, order, strict=True))
    for number in range(FOLDS):
        fold = Fold([], [], [])
        for scene in scenes:
            row, of = divmod(place[scene.group], FOLDS)
            part = fold.train if row % _VALIDATION else fold.validation
            (fold.test if of == number else part).append(scene)
        yield fold


def cross_validate(
    artifact: Artifact, scenes: Sequence[EncodedScene]
) -> dict[tuple[str, str], Ratio]:
    """Return the metrics of the task by (data source, name). A unit of a ratio is a group."""
    vocabulary = artifact.vocabulary
    structure = torch.from_numpy(vocabulary.structure.copy())
    annotated = annotated_classes(list(scenes), vocabulary)
    found: dict[tuple[str, str], list[Ratio]] = defaultdict(list)

    def tensors(some: Sequence[EncodedScene]) -> SceneTensors:
        return scene_tensors(some, annotated, len(vocabulary))

    for fold in folds(scenes):
        counts = fit_counts(fold.train, fold.validation, vocabulary)
        contender, train = Contender(artifact=replace(artifact, counts=counts)), tensors(fold.train)
        for source in sorted({scene.source for scene in fold.test}):
            test = tensors([scene for scene in fold.test if scene.source == source])
            settings = [Setting(test, structure, train, seed=seed) for seed in range(PARTS)]
            outcomes = [counts_task(contender, setting) for setting in settings]
            for name in METRICS:
                parts = [outcome.metrics.get(name) for outcome in outcomes if outcome]
                ratios = [part for part in parts if isinstance(part, Ratio)]
                if ratios:
                    found[source, name].append(_pooled(ratios))
    return {key: Ratio.join(ratios) for key, ratios in found.items()}


def _pooled(parts: Sequence[Ratio]) -> Ratio:
    """Return the ratio over the items of all parts, which have the same units."""
    return Ratio(
        np.sum([part.numerators for part in parts], axis=0),
        np.sum([part.denominators for part in parts], axis=0),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("model_store"))
    parser.add_argument("--model", default="default")
    parser.add_argument("--data", type=Path, default=DATA)
    asked = parser.parse_args()
    artifact = load_model_set(Store(asked.store)).resolve(asked.model)
    data = Config.model_validate(artifact.manifest.training["config"]).data
    sources = read_sources(data, asked.data)
    parts = split_and_encode(data, sources, artifact.vocabulary, asked.data).parts
    scenes = [scene for part in parts.values() for scene in part]
    print(f"{artifact.manifest.name}@{artifact.manifest.version}")
    for (source, name), ratio in sorted(cross_validate(artifact, scenes).items()):
        groups = int((ratio.denominators > 0).sum())
        print(f"{source:<20} {name:<36} {ratio.figure()}  {ratio.n} cases, {groups} groups")


if __name__ == "__main__":
    main()
