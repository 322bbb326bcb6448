"""Cross-validate the statistics of counts of a model: is the expected count the better one?

The statistics are fitted to four of five folds of the scenes. Then the task of
`training.evaluation.counts` measures the fifth fold, with four random parts of each scene. The
statistics do not depend on the weights of the model, so its training scenes can be test scenes.

Run as `python -m scripts.count_folds --model NAME --data FOLDER`. `python -m training fetch` says
what belongs into the folder.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import torch

from app.registry import Artifact, Store, load_model_set
from training.batches import SceneTensors, scene_tensors
from training.config import DATA, Config
from training.counts import fit_counts, folds
from training.datasets import EncodedScene, annotated_classes
from training.evaluation.counts import METRICS, counts_task
from training.evaluation.metrics import Ratio
from training.evaluation.setting import Contender, Setting
from training.pipeline import read_sources, split_and_encode

PARTS: Final = 4


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

    for train, test in folds(scenes):
        contender = Contender(artifact=replace(artifact, counts=fit_counts(train, vocabulary)))
        known = tensors(train)
        for source in sorted({scene.source for scene in test}):
            asked = tensors([scene for scene in test if scene.source == source])
            settings = [Setting(asked, structure, known, seed=seed) for seed in range(PARTS)]
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
